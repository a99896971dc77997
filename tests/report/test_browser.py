"""The pictures in a real browser, under a policy that allows neither inline scripts nor styles, nor eval."""

from __future__ import annotations

import functools
import http.server
import io
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import zakai
from report.fakes import fake_result
from zakai.report.charts import Chart, axis
from zakai.report.html import write_report
from zakai.report.picture import picture_bytes
from zakai.report.plane import plane_bytes

STATIC = Path(zakai.__file__).parent / "report" / "static"
PAGE = """<!DOCTYPE html><html><head><meta charset="utf-8"><link rel="icon" href="data:,"><link rel="stylesheet" href="page.css">
</head><body><div id="place"></div><p>below</p><script type="module" src="start.js"></script></body></html>"""
START = """
import { DensityView } from "./density.js";
import { PlaneView } from "./plane.js";
import { ChartView } from "./chart.js";
const [kind, file] = location.search.slice(1).split(",");
const View = { density: DensityView, plane: PlaneView, chart: ChartView }[kind];
window.seen = [];
window.view = new View(document.getElementById("place"), { testid: kind, onViewChange: (one) => window.seen.push(one) });
window.load = async (name) => window.view.setFrame(await (await fetch(name)).arrayBuffer());
await window.load(file);
requestAnimationFrame(() => requestAnimationFrame(() => { document.body.dataset.ready = ""; }));
"""
CSS = (
    "body { background: #fff; margin: 20px; height: 3000px } @media (prefers-color-scheme: dark) { body { background: #14181f } }"
)
POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:"


class Handler(http.server.SimpleHTTPRequestHandler):
    extensions_map = {".js": "text/javascript", ".html": "text/html", ".css": "text/css", "": "application/octet-stream"}

    def end_headers(self):
        self.send_header("Content-Security-Policy", POLICY)
        super().end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def result():
    return fake_result(observations=400, state=("theta", "rate"))


@pytest.fixture(scope="module")
def address(tmp_path_factory, result):
    folder = tmp_path_factory.mktemp("page")
    for script in STATIC.glob("*.js"):
        shutil.copy(script, folder)
    one, truth = result
    many, _ = fake_result(observations=20_000)
    chart = Chart()
    chart.panel("bars", axis("probability", 0, 1), axis("density", 0, 2)).add(
        "bars", [0.25, 0.75], [1.5, 0.5], width=0.4, text="u"
    )
    chart.panel("line", axis("t"), axis("size", log=True), link="t").add("line", [0.0, 1.0, 2.0], [1.0, 10.0, 100.0], text="size")
    files = {
        "page.html": PAGE.encode(), "page.css": CSS.encode(), "start.js": START.encode(),
        "one": picture_bytes(one, 0, truth=truth), "rate": picture_bytes(one, 1), "many": picture_bytes(many, columns=500),
        "part": picture_bytes(many, window=(500.0, 510.0)), "plane": plane_bytes(one, index=[100, 200, 400], truth=truth),
        "chart": chart.frame(),
    }  # fmt: skip
    for name, data in files.items():
        (folder / name).write_bytes(data)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/page.html"
        server.shutdown()


@pytest.fixture
def opened(browser, address):
    """A function that opens a picture; nothing may be refused or fail in its page."""
    said, contexts = [], []

    def opened(query, **options):
        context = browser.new_context(viewport={"width": 900, "height": 700}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(f"{address}?{query}")
        page.wait_for_selector("body[data-ready]")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert said == []


def canvas(page, name="density"):
    return page.get_by_test_id(name)


def settled(page):
    """Wait until what was asked for is drawn."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def pixels(page, name="density"):
    settled(page)
    return np.asarray(Image.open(io.BytesIO(canvas(page, name).screenshot())).convert("RGB"), float)


def point(page, x, y, name="density"):
    """Move the mouse to a place of the axes and return what is said there."""
    place = page.evaluate("([x, y]) => [view.px(x), view.py(y)]", [x, y])
    box = canvas(page, name).bounding_box()
    page.mouse.move(box["x"] + place[0], box["y"] + place[1])
    settled(page)
    return page.get_by_test_id(f"{name}-hover").locator("div").all_inner_texts()


def numbers(line):
    found = [
        part for part in line.replace("−", "-").replace("=", " ").replace(")", " ").split() if part.lstrip("-")[:1].isdigit()
    ]
    return [float(part) for part in found]


def until(page, condition, argument=None):
    """Wait until a condition holds; Playwright's own waiting needs eval, which the policy forbids."""
    for _ in range(600):
        if page.evaluate(f"(argument) => Boolean({condition})", argument):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never true: {condition}")


def view_of(page):
    return page.evaluate("({x: view.view.x, y: view.view.y})")


def test_what_is_said_at_the_pointer_is_the_density_there(opened, result):
    one, truth = result
    page = opened("density,one")
    k, value = 200, float(one.mean[200, 0] + 0.5 * np.sqrt(one.variance[200, 0]))
    lines = point(page, float(one.times[k]), value)
    density = one.density(k).marginal(0)
    seen = numbers(lines[1])[0]  # the value of the middle of a pixel
    assert lines[0] == f"t = {one.times[k]:g}" and seen == pytest.approx(value, abs=0.05)
    assert numbers(lines[2])[0] == pytest.approx(float(density.pdf(np.array([seen]))), rel=5e-3)
    assert lines[3].startswith("P(theta ≤") and numbers(lines[3])[-1] == pytest.approx(0.69, abs=0.05)
    assert numbers(lines[4])[0] == pytest.approx(one.mean[k, 0], rel=1e-4)
    assert numbers(lines[5].replace("95%", ""))[:2] == pytest.approx(density.quantile([0.025, 0.975])[:, 0], rel=5e-3)
    assert numbers(lines[6])[0] == pytest.approx(truth[k, 0], rel=1e-4)


def test_a_pixel_is_as_dark_as_the_density_relative_to_its_peak(opened, result):
    one, _ = result
    page = opened("density,one")
    page.evaluate("for (const role of ['mean', 'band', 'truth']) view.hidden.add(role); view.redraw()")
    picture = pixels(page).sum(axis=2)
    k, spread = 200, float(np.sqrt(one.variance[200, 0]))
    places = [one.mean[k, 0] + away * spread for away in (0.0, 1.0, 2.0, 4.5)]
    at = page.evaluate(
        "([t, ys]) => ys.map((y) => [Math.round(view.px(t)), Math.round(view.py(y))])", [float(one.times[k]), places]
    )
    shades = [picture[y, x] for x, y in at]
    assert shades[0] < shades[1] < shades[2] < shades[3] == 3 * 255


def test_buttons_wheel_drag_and_keys_change_the_picture_and_announce_what_is_seen(opened):
    page = opened("density,one")
    whole, before = pixels(page), view_of(page)
    page.get_by_role("button", name="Zoom in").click()
    closer, after = pixels(page), view_of(page)
    assert np.abs(closer - whole).mean() > 1 and after["x"][1] - after["x"][0] == pytest.approx(
        0.5 * (before["x"][1] - before["x"][0])
    )
    seen = page.evaluate("seen.at(-1)")
    assert [seen["from"], seen["to"]] == after["x"] and seen["width"] > 500
    box = canvas(page).bounding_box()
    page.mouse.move(box["x"] + 400, box["y"] + 150)
    page.mouse.down()
    page.mouse.move(box["x"] + 500, box["y"] + 150, steps=4)
    page.mouse.up()
    dragged = view_of(page)
    assert dragged["x"][0] < after["x"][0] and np.abs(pixels(page) - closer).mean() > 1
    page.mouse.wheel(0, -300)  # the picture has the focus
    until(page, "view.view.x[1] - view.view.x[0] < 0.95 * argument", np.ptp(dragged["x"]).item())
    scrolled = page.evaluate("scrollY")
    for key, axis_ in (("+", "x"), ("Shift+ArrowRight", "x"), ("Shift+ArrowUp", "y"), ("Shift+*", "y")):
        last = view_of(page)
        page.keyboard.press(key)
        assert view_of(page)[axis_] != last[axis_], key
    assert page.evaluate("scrollY") == scrolled
    page.keyboard.press("0")
    page.mouse.move(0, 0)
    assert view_of(page) == before and np.array_equal(pixels(page)[10:-10, 10:-10], whole[10:-10, 10:-10])


def test_without_the_focus_the_wheel_scrolls_the_page(opened):
    page = opened("density,one")
    before = view_of(page)
    box = canvas(page).bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 100)
    page.mouse.wheel(0, 300)
    until(page, "scrollY > 0")
    assert view_of(page) == before


def test_by_keyboard_the_pointer_goes_from_time_to_time_and_is_read_aloud(opened, result):
    page = opened("density,one")
    canvas(page).focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    k = 203  # three times after the middle
    said = page.locator("[role=status]")
    until(page, "document.querySelector('[role=status]').textContent.startsWith(argument)", f"t = {result[0].times[k]:g},")
    assert f"mean {result[0].mean[k, 0]:.3f}"[:-1].replace("-", "−") in said.inner_text()
    assert page.get_by_role("img", name="Density of theta over time").count() == 1
    page.get_by_role("button", name="Mouse and keys").click()
    assert page.get_by_text("Escape hides the pointer").is_visible()
    page.get_by_role("button", name="mean").click()
    settled(page)
    assert page.get_by_role("button", name="mean").get_attribute("aria-pressed") == "false"


def test_two_fingers_zoom_and_one_moves(opened):
    page = opened("density,one", has_touch=True)
    before, box = view_of(page), canvas(page).bounding_box()
    touch = page.context.new_cdp_session(page)

    def send(kind, *xs):
        points = [{"x": box["x"] + x, "y": box["y"] + 100, "id": i} for i, x in enumerate(xs)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    send("touchStart", 300, 500)
    for out in range(1, 9):
        send("touchMove", 300 - 15 * out, 500 + 15 * out)
    send("touchEnd")
    until(page, "view.view.x[1] - view.view.x[0] < 0.8 * argument", np.ptp(before["x"]).item())
    zoomed = view_of(page)
    send("touchStart", 300)
    for out in range(1, 9):
        send("touchMove", 300 + 12 * out)
    send("touchEnd")
    until(page, "view.view.x[0] < argument", zoomed["x"][0])


def test_a_view_asks_for_what_it_does_not_hold_and_only_for_that(opened):
    page = opened("density,many")
    assert page.evaluate("view.state().wanted") is None
    page.evaluate("view.setView({ x: [501, 509], y: view.view.y })")
    wanted = page.evaluate("view.state().wanted")
    assert wanted["from"] == pytest.approx(497) and wanted["to"] == pytest.approx(513)
    coarse = pixels(page)
    page.evaluate("load('part')")
    until(page, "view.state().wanted === null")
    assert np.abs(pixels(page) - coarse).mean() > 1 and view_of(page)["x"] == [501, 509]
    page.evaluate("view.setView({ x: [400, 600], y: view.view.y })")  # the rest is drawn by the first frame
    assert (pixels(page)[10:300, 80:300].sum(axis=2) < 700).any()
    page.evaluate("load('rate')")  # of another state
    until(page, "view.frame.header.name === 'rate' && view.view.x[1] === view.home.x[1]")


def test_no_frame_of_a_long_record_takes_100_ms(opened):
    page = opened("density,many", device_scale_factor=2)
    spent = page.evaluate("""() => {
        const times = [];
        for (let k = 0; k < 12; k++) {
          view.zoom("x", k % 2 ? 1.9 : 0.5, 900);
          const before = performance.now();
          view.draw();
          times.push(performance.now() - before);
        }
        return times.sort((a, b) => a - b)[6];
    }""")
    assert spent < 2000  # of a frame on a machine with any load; the figure is measured in benchmarks/


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_picture_has_the_background_of_its_page_and_lines_that_stand_out(opened, scheme):
    page = opened("density,one", color_scheme=scheme)
    background, ink = ((255, 255, 255), (29, 36, 48)) if scheme == "light" else ((20, 24, 31), (242, 244, 247))
    picture = pixels(page)
    assert tuple(picture[5, -4]) == background
    assert (np.abs(picture - ink).sum(axis=2) < 40).sum() > 100


def test_a_picture_is_sharp_on_a_screen_of_high_density_and_fits_a_phone(opened):
    page = opened("density,one", device_scale_factor=2)
    assert canvas(page).evaluate("(one) => one.width / one.clientWidth") == 2
    page.set_viewport_size({"width": 340, "height": 700})
    until(page, "document.querySelector('[data-testid=density]').width < 640")
    assert page.evaluate("document.documentElement.scrollWidth") <= 340
    assert page.get_by_role("button", name="Zoom in").is_visible()


def test_the_slider_of_a_joint_density_shows_another_time(opened, result):
    one, _ = result
    page = opened("plane,plane")
    before = pixels(page, "plane")
    page.get_by_role("slider", name="Time").press("Home")
    until(page, "view.at === 0")
    assert np.abs(pixels(page, "plane") - before).mean() > 0.3 and page.get_by_text("t = 10", exact=True).is_visible()
    mean = one.mean[100].tolist()
    lines = point(page, *mean, "plane")
    expected = one.density(100).pdf(np.array([[numbers(lines[0])[0], numbers(lines[1])[0]]]))[0]
    assert numbers(lines[2])[0] == pytest.approx(expected, rel=0.02)


def test_a_chart_says_its_values_and_links_its_axes(opened):
    page = opened("chart,chart")
    assert np.ptp(pixels(page, "chart")) > 100
    box = page.get_by_test_id("chart-1").bounding_box()
    place = page.evaluate("[view.panels[1].px(1), view.panels[1].py(1)]")
    page.mouse.move(box["x"] + place[0] + 3, box["y"] + place[1])
    settled(page)
    assert page.get_by_test_id("chart-1-hover").locator("div").all_inner_texts() == ["t 1", "size 10"]


def test_a_frame_that_is_none_is_refused_in_one_sentence(opened):
    page = opened("density,one")
    said = page.evaluate("() => { try { view.setFrame(new ArrayBuffer(40)); } catch (error) { return String(error); } }")
    assert said == "Error: not a frame of zakai"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_report_draws_every_picture_by_its_own_script_alone(browser, tmp_path, scheme):
    one, truth = fake_result(observations=700, state=("theta", "rate"), periodic=("theta",))
    write_report(one, tmp_path / "report.html", truth)
    said, asked = [], []
    with browser.new_context(viewport={"width": 360, "height": 800}, color_scheme=scheme) as context:
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(f"file://{tmp_path}/report.html")
        places = page.locator("[data-zakai]")
        until(page, "[...document.querySelectorAll('[data-zakai]')].every((one) => one.querySelector('canvas'))")
        assert places.count() >= 8
        for name in ("posterior-0", "detail-1", "joint-0-1", "snapshots-0", "log-likelihood-figure", "health-figures"):
            page.get_by_test_id(name).scroll_into_view_if_needed()
            assert np.std(pixels(page, name)) > 5, name
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        page.evaluate("document.body.append(Object.assign(document.createElement('script'), { textContent: 'window.bad = 1' }))")
        assert page.evaluate("window.bad") is None
        assert all("Content Security Policy" in line for line in said) and asked == [f"file://{tmp_path}/report.html"]


def test_a_result_in_a_notebook_is_a_picture_in_a_sandbox(browser, tmp_path):
    one, _ = fake_result(observations=50)
    from zakai.report import notebook_picture

    (tmp_path / "cell.html").write_text(f"<body>{notebook_picture(one)}</body>")
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"file://{tmp_path}/cell.html")
        inside = page.frame_locator("iframe").get_by_test_id("picture")
        inside.wait_for()
        page.mouse.move(400, 200)
        page.frame_locator("iframe").get_by_test_id("picture-hover").wait_for()
        assert page.evaluate("document.querySelector('iframe').contentDocument") is None  # nothing of the notebook can be reached


def test_the_script_of_a_widget_draws_its_frame_and_sends_its_wishes_one_at_a_time(browser, tmp_path):
    from zakai.report.widget import _widget_class

    one, _ = fake_result(observations=20_000)
    shown = zakai.widget(one)
    (tmp_path / "widget.js").write_text(_widget_class()._esm)
    (tmp_path / "frame").write_bytes(shown.frame)
    (tmp_path / "cell.html").write_text("<div id=el></div>")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=tmp_path)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with browser.new_context() as context:
            page = context.new_page()
            page.goto(f"http://127.0.0.1:{server.server_port}/cell.html")
            page.evaluate("""async () => {
                const { default: widget } = await import("./widget.js");
                const frame = new DataView(await (await fetch("frame")).arrayBuffer());
                const data = { frame, names: ["x"], coordinate: "x", height: 300 };
                window.sent = [];
                window.calls = {};
                const model = { get: (name) => data[name], off() {}, send: (one) => sent.push(one) };
                model.on = (name, call) => (calls[name] = call);
                widget.render({ model, el: document.getElementById("el") });
            }""")
            for _ in range(5):
                page.get_by_role("button", name="Zoom in").click()
                settled(page)
            assert page.evaluate("sent.length") == 1
            page.evaluate("calls['msg:custom']({ coordinate: 'x' }, [])")
            assert page.evaluate("sent.length") == 2
            first, last = (np.ptp(one["wanted"]) for one in page.evaluate("sent"))
            assert last < first
        server.shutdown()
