"""The studio in a real browser: what a person does, in Debian's chromium."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

import zakai
from zakai.records import write_truth

PATIENCE = 120_000  # milliseconds: the first run of a machine compiles kernels
expect.set_options(timeout=PATIENCE)


@pytest.fixture(scope="module")
def address():
    """The address that one studio prints, for all tests."""
    command = [sys.executable, "-m", "zakai", "studio", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield re.search(r"http://\S+", process.stdout.readline())[0]
        process.terminate()
        assert "Traceback" not in process.communicate()[1]


@pytest.fixture
def page(browser: Browser, address: str):
    """A page with the worked example, filtered; nothing may be refused or fail in it."""
    with browser.new_context(viewport={"width": 1280, "height": 800}, accept_downloads=True) as context:
        page, said = context.new_page(), []
        page.set_default_timeout(PATIENCE)
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(address)
        expect_status(page, "Filtered")
        yield page
        assert said == []


def expect_status(page: Page, words: str) -> None:
    expect(page.locator("#status")).to_contain_text(words, timeout=PATIENCE)


def picture(page: Page) -> bytes:
    """The pixels of the density."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.get_by_test_id("density").screenshot()


def expect_another_picture(page: Page, before: bytes) -> None:
    ends = time.monotonic() + PATIENCE / 1000
    while picture(page) == before:
        assert time.monotonic() < ends, "the density is the same"


def likelihood(page: Page) -> str:
    return page.get_by_test_id("fact-log-likelihood").inner_text()


def replace(page: Page, old: str, new: str) -> None:
    """Type another text for a part of the model."""
    text = page.get_by_test_id("model-text")
    text.fill(text.input_value().replace(old, new))


def test_a_model_of_the_gallery_is_loaded_and_a_record_of_the_user_filtered(page: Page, tmp_path: Path):
    page.get_by_test_id("gallery").select_option("cubic-sensor")
    expect(page.locator("#title")).to_have_text(zakai.gallery.load("cubic-sensor").name)
    expect_status(page, "Filtered")
    before = picture(page)
    model = zakai.gallery.load("cubic-sensor")
    truth, record = zakai.simulate(model, [0.1 * k for k in range(1, 41)], seed=3)
    record.to_csv(tmp_path / "mine.csv", ["voltage"])
    write_truth(tmp_path / "truth.csv", truth, model.state)
    page.get_by_test_id("data-file").click()
    page.get_by_test_id("record-file").set_input_files(tmp_path / "mine.csv")
    expect(page.locator("#data-said")).to_contain_text("mine.csv, 40 rows")
    expect(page.get_by_test_id("fact-observations")).to_have_text("40")
    expect_another_picture(page, before)
    expected = zakai.filter(model, zakai.read_record(tmp_path / "mine.csv", model)).log_likelihood
    assert float(likelihood(page).replace("−", "-")) == pytest.approx(expected, rel=1e-6)
    before = picture(page)
    page.get_by_test_id("truth-file").set_input_files(tmp_path / "mine.csv")  # not its true states
    expect(page.get_by_test_id("data-error")).to_contain_text("mine.csv")
    page.get_by_test_id("truth-file").set_input_files(tmp_path / "truth.csv")
    expect(page.get_by_test_id("data-error")).to_be_hidden()
    expect_another_picture(page, before)


def test_the_density_follows_a_slider_while_it_is_dragged_and_is_filtered_again_when_it_is_released(page: Page):
    before, said = picture(page), likelihood(page)
    slider = page.get_by_test_id("slider-s")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    page.mouse.move(box["x"] + 0.34 * box["width"], box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + box["height"] / 2, steps=4)
    expect_status(page, "log-likelihood about")
    expect_another_picture(page, before)
    assert likelihood(page) == said  # that of the last whole run
    page.mouse.up()
    expect_status(page, "Filtered 600")
    expect(page.get_by_test_id("fact-log-likelihood")).not_to_have_text(said)
    assert "s = 0.6\n" not in page.get_by_test_id("model-text").input_value()


def test_an_error_of_the_model_is_shown_at_its_place_while_one_types(page: Page):
    replace(page, "a*(x - x**3)", "a*(x - y**3)")
    error = page.get_by_test_id("model-error")
    expect(error).to_contain_text("unknown name 'y'")
    expect(error).to_contain_text("line 6")
    expect(page.locator(".copy .wrong")).to_have_text("y**3)")
    expect(page.get_by_test_id("run")).to_be_disabled()
    replace(page, "y**3", "x**3")
    expect(error).to_be_hidden()
    expect(page.get_by_test_id("run")).to_be_enabled()


def test_a_long_equation_is_made_smaller_and_seen_whole(page: Page):
    replace(page, 'drift = ["', 'drift = ["(sin(3.25*x) + 2)/(cos(x) + 47) + 3.875*exp(-2.25*x**2) + atan(2.5*x + 0.125) + ')
    expect(page.locator("#equations")).to_contain_text("47")
    width, widest = page.locator("#equations").evaluate(
        "box => [box.clientWidth, Math.max(...[...box.querySelectorAll('math')].map((one) => one.getBoundingClientRect().width))]"
    )
    assert widest <= width


def test_a_model_file_of_the_user_is_opened(page: Page, tmp_path: Path):
    (tmp_path / "mine.toml").write_text(zakai.gallery.text("kalman-bucy-1d"))
    page.get_by_test_id("model-file").set_input_files(tmp_path / "mine.toml")
    expect(page.get_by_test_id("fact-method")).to_have_text("kalman-bucy")


def test_the_form_and_the_text_say_the_same(page: Page):
    page.get_by_test_id("view-form").click()
    drift = page.get_by_label("drift of x")
    expect(drift).to_have_value("a*(x - x**3)")
    drift.fill("a*x")
    drift.press("Tab")
    page.get_by_test_id("view-text").click()
    expect(page.get_by_test_id("model-text")).to_have_value(re.compile(r'^# A particle.*drift = \["a\*x"\]', re.DOTALL))


def test_a_long_run_is_cancelled_and_the_page_lives(page: Page):
    page.get_by_test_id("gallery").select_option("lorenz")
    expect(page.get_by_test_id("cancel")).to_be_visible()
    page.get_by_test_id("cancel").click()
    expect_status(page, "Cancelled")
    page.get_by_test_id("gallery").select_option("*")
    expect_status(page, "Filtered 600")


def test_a_bad_file_is_refused_with_its_row(page: Page, tmp_path: Path):
    (tmp_path / "bad.csv").write_text("time,x\n0.1,1\n0.2,much\n")
    page.get_by_test_id("data-file").click()
    page.get_by_test_id("record-file").set_input_files(tmp_path / "bad.csv")
    expect(page.get_by_test_id("data-error")).to_contain_text("bad.csv: row 3: 'much'")
    page.get_by_test_id("data-simulate").click()
    expect(page.get_by_test_id("data-error")).to_be_hidden()


def test_the_address_restores_the_page(page: Page, address: str):
    replace(page, "r = 0.6", "r = 0.5")
    page.get_by_test_id("run").click()
    expect_status(page, "Filtered")
    said = likelihood(page)
    expect(page).to_have_url(re.compile("#"))
    page.wait_for_timeout(600)
    page.reload()
    expect(page.get_by_test_id("model-text")).to_have_value(re.compile("r = 0.5"))
    expect_status(page, "Filtered")
    assert likelihood(page) == said


def test_the_script_that_is_downloaded_gives_the_same_numbers(page: Page, tmp_path: Path):
    page.get_by_test_id("tab-export").click()
    with page.expect_download() as download:
        page.get_by_test_id("export-script").click()
    download.value.save_as(tmp_path / "filter.py")
    command = [sys.executable, "filter.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, env={**os.environ})
    computed = float(re.search(r"log-likelihood (\S+)", done.stdout)[1])
    assert float(likelihood(page).replace("−", "-")) == pytest.approx(computed, abs=5e-5)
    assert (tmp_path / "result.nc").is_file()


def test_every_part_of_the_page_opens_by_keyboard(page: Page):
    seen = {
        "summary": ".lead",
        "observations": "canvas[data-testid=observed-y1]",
        "residuals": "canvas[data-testid=pit-y1]",
        "joint": "p",
        "compare": "[data-testid=keep]",
        "stream": "[data-testid=follow]",
        "algebra": "[data-testid=verdict]",
        "export": "pre",
    }
    page.get_by_test_id("tab-parameters").focus()
    for part, element in seen.items():
        page.keyboard.press("ArrowRight")
        expect(page.get_by_test_id(f"tab-{part}")).to_be_focused()
        expect(page.locator(f"#panel-{part} {element}").first).to_be_visible(timeout=PATIENCE)
        expect(page.locator(f"#panel-{part} .fault:visible")).to_have_count(0)


def test_nothing_is_wider_than_a_phone(browser: Browser, address: str):
    with browser.new_context(viewport={"width": 360, "height": 740}) as context:
        page = context.new_page()
        page.goto(address)
        expect_status(page, "Filtered")
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        for testid in ("model-text", "run", "method", "slider-a", "density"):
            expect(page.get_by_test_id(testid)).to_be_visible()


def open_part(page: Page, part: str) -> None:
    page.get_by_test_id(f"tab-{part}").click()


def test_a_slider_keeps_the_record_so_that_two_values_are_compared(page: Page):
    open_part(page, "compare")
    page.get_by_test_id("keep").click()
    expect_status(page, "Kept as")
    before, seen = likelihood(page), page.get_by_role("img", name="The record").screenshot()
    open_part(page, "parameters")
    page.get_by_test_id("value-r").fill("0.9")
    page.get_by_test_id("value-r").press("Enter")
    expect(page.get_by_test_id("fact-log-likelihood")).not_to_have_text(before)
    expect_status(page, "Filtered 600")
    assert page.get_by_role("img", name="The record").screenshot() == seen
    open_part(page, "compare")
    page.get_by_test_id("keep").click()
    rows = page.get_by_test_id("compare-table").locator("tbody tr")
    expect(rows).to_have_count(2)
    figures = [float(cell.replace("−", "-")) for cell in rows.locator("td:nth-child(3)").all_inner_texts()]
    shown = [float(value.replace("−", "-")) for value in (before, likelihood(page))]
    assert figures == pytest.approx(shown, abs=1e-3) and figures[0] > figures[1]
    page.get_by_test_id("keep-record").click()  # simulate again, with the new value
    expect(page.get_by_test_id("fact-log-likelihood")).not_to_have_text(re.compile(re.escape(f"{shown[1]}".replace("-", "−"))))


def test_a_record_is_filtered_although_it_is_described_twice_at_a_time(page: Page):
    page.evaluate("""() => {
        const { data, state } = window.studio;
        state.data = { ...state.data, until: 30 };
        data.changed();
        data.describe.now();
    }""")
    expect_status(page, "Filtered 300 ")


def test_the_reader_chooses_the_end_of_the_forecast(page: Page):
    page.get_by_test_id("show-forecast").click()
    expect(page.get_by_test_id("forecast-until")).to_have_value("72")
    page.get_by_test_id("forecast-until").fill("200")
    page.get_by_test_id("forecast-until").press("Enter")
    expect_status(page, "Forecast: 140 beyond")
    expect(page.locator("#verdict")).to_contain_text("t = 200")
    page.get_by_test_id("forecast-until").fill("9")
    page.get_by_test_id("forecast-until").press("Enter")
    expect_status(page, "after the end of the record, 60")


def test_the_observations_of_a_slow_method_show_their_progress_and_end_for_a_run(page: Page):
    page.get_by_test_id("option-tolerance").fill("1e-9")
    page.get_by_test_id("option-tolerance").press("Enter")
    page.get_by_test_id("simulate-until").fill("600")
    page.get_by_test_id("simulate-until").press("Enter")
    expect_status(page, "Filtered 6,000")
    open_part(page, "residuals")
    expect(page.get_by_test_id("progress")).to_have_attribute("aria-valuenow", re.compile(r"\d"))
    page.get_by_test_id("simulate-until").fill("10")
    page.get_by_test_id("simulate-until").press("Enter")
    expect_status(page, "Filtered 100")
    expect(page.locator("canvas[data-testid=pit-y1]")).to_be_visible(timeout=PATIENCE)


def test_a_profile_shows_the_values_around_the_maximum(page: Page):
    page.get_by_test_id("profile-of").select_option("r")
    page.get_by_test_id("profile").click()
    expect_status(page, "The log-likelihood for values of r")
    heights = page.evaluate("[...window.studio.tabs.get('parameters').profiled.series[0].y]")
    finite = [height for height in heights if height == height]
    assert len(heights) == 15 and sum(height > max(finite) - 6 for height in finite) >= 7


def test_a_record_with_other_names_of_its_columns_is_mapped(page: Page, tmp_path: Path):
    rows = "".join(f"{0.3 * k:g};{k};2024-01-01 00:{k:02}:00\n" for k in range(1, 31))
    (tmp_path / "mine.csv").write_text("level;number;Timestamp\n" + rows)
    page.get_by_test_id("data-file").click()
    page.get_by_test_id("record-file").set_input_files(tmp_path / "mine.csv")
    expect(page.get_by_test_id("column-time")).to_have_value("Timestamp")
    expect(page.get_by_test_id("data-error")).to_contain_text("Choose the column of y1")
    page.get_by_test_id("column-y1").select_option("level")
    expect(page.get_by_test_id("fact-observations")).to_have_text("30", timeout=PATIENCE)
    expect(page.get_by_test_id("data-facts")).to_contain_text("t = 0 at 2024-01-01 00:01:00")
    page.get_by_test_id("record-origin").fill("2024-01-01")
    page.get_by_test_id("record-origin").press("Tab")
    expect(page.get_by_test_id("data-facts")).to_contain_text("t = 0 at 2024-01-01 00:00:00")
    page.get_by_test_id("column-time").select_option("number")
    page.get_by_test_id("column-y1").select_option("level")
    expect(page.get_by_test_id("data-facts")).to_contain_text("times 1 to 30")
