"""Figures of the studio in a browser: start, slider, long records, memory, bad texts; a line for each as it is measured.

    python -m benchmarks.studio [start] [slider] [long] [memory] [texts]
"""

from __future__ import annotations

import json
import random
import re
import shutil
import statistics
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, expect, sync_playwright

CORPUS = Path(__file__).parents[1] / "fuzz" / "corpus"
SPIRAL = """name = "spiral sensor"
state = ["x"]
drift = ["a*t*x"]
observation = ["x*sin(x)", "x*cos(x)"]
observation_kind = "increments"
[parameters]
a = 0.025
[prior]
kind = "gaussian"
mean = [0.1]
cov = [[3.0]]
"""
WALK = """name = "random walk"
state = ["x"]
drift = ["-x/10"]
observation = ["x"]
observation_noise = [["0.5"]]
observation_kind = "samples"
[prior]
kind = "gaussian"
mean = [0.0]
cov = [[1.0]]
"""
PATIENCE = 300_000
FRAMES = """() => new Promise((done) => {
  const steps = [], ends = performance.now() + 5000;
  let last = performance.now();
  (function next() {
    const now = performance.now();
    steps.push(now - last);
    last = now;
    if (now < ends) requestAnimationFrame(next); else done(steps.slice(1));
  })();
})"""
ASK = """async (texts) => {
  const said = [];
  for (const text of texts) {
    try {
      const found = await window.studio.link.ask("check", { text });
      said.push(found.fault ?? null);
    } catch (error) { said.push("error: " + error.message); }
  }
  return said;
}"""


@contextmanager
def studio() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A studio, and its address."""
    command = [sys.executable, "-m", "zakai", "studio", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[-1], process
        finally:
            process.terminate()


@contextmanager
def opened(text: str, data: dict[str, object]) -> Iterator[tuple[Page, subprocess.Popen[str]]]:
    """A page with a model and a record, filtered."""
    with studio() as (address, process), sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(PATIENCE)
        page.goto(address)
        expect(page.locator("#status")).to_contain_text("Filtered", timeout=PATIENCE)
        page.evaluate("([text, data]) => window.studio.load(text, data)", [text, data])
        expect(page.locator("#title")).to_have_text(re.search('name = "(.*)"', text)[1])
        expect(page.locator("#status")).to_contain_text("Filtered", timeout=PATIENCE)
        page.wait_for_timeout(3000)
        yield page, process
        browser.close()


def start() -> dict[str, object]:
    """Seconds from the command to a page that answers."""
    found = []
    for _ in range(3):
        began = time.perf_counter()
        with studio() as (address, _):
            while urllib.request.urlopen(address).status != 200:
                time.sleep(0.01)
            found.append(time.perf_counter() - began)
    return {"seconds to a page that answers": round(statistics.median(found), 2)}


def slider() -> dict[str, object]:
    """Milliseconds from a slider to the picture, for the spiral sensor and 1,000 observations."""
    with opened(SPIRAL, {"kind": "simulate", "until": 10, "step": 0.01, "seed": 1}) as (page, _):
        page.get_by_test_id("slider-a").scroll_into_view_if_needed()
        box = page.get_by_test_id("slider-a").bounding_box()
        middle = box["y"] + box["height"] / 2
        page.mouse.move(box["x"] + 0.3 * box["width"], middle)
        page.mouse.down()
        for k in range(120):
            page.mouse.move(box["x"] + (0.3 + 0.3 * abs(k % 40 - 20) / 20) * box["width"], middle)
            page.wait_for_timeout(50)
        found = page.evaluate("performance.getEntriesByName('slide').map((entry) => entry.duration)")
        page.mouse.up()
    return {"pictures": len(found), "median ms": round(statistics.median(found), 1), "worst ms": round(max(found), 1)}


def long() -> dict[str, object]:
    """Milliseconds between frames while 100,000 observations are zoomed and moved."""
    with opened(WALK, {"kind": "simulate", "until": 10_000, "step": 0.1, "seed": 1}) as (page, _):
        page.get_by_test_id("density").focus()
        page.evaluate(f"window.frames = ({FRAMES})()")
        for key in ["+"] * 14 + ["Shift+ArrowRight"] * 14 + ["-"] * 8 + ["Shift+ArrowLeft"] * 8:
            page.keyboard.press(key)
            page.wait_for_timeout(60)
        worst = max(page.evaluate("window.frames"))
        rows = page.get_by_test_id("fact-observations").inner_text()
        seen = page.evaluate("(({ from, to }) => [from, to])(window.studio.result.view.state())")
    return {"observations": rows, "longest frame ms": round(worst, 1), "times that are seen at the end": seen}


def memory() -> dict[str, object]:
    """Resident memory of the processes after 20 and after 220 runs."""
    with opened(SPIRAL, {"kind": "simulate", "until": 4, "step": 0.01, "seed": 1}) as (page, process):
        sizes = []
        for count in (20, 200):
            page.evaluate("async (count) => { for (let k = 0; k < count; k++) await window.studio.run(); }", count)
            sizes.append(resident(process.pid))
    growth = round(sizes[1] / sizes[0] - 1, 3)
    return {"MiB after 20 runs": round(sizes[0]), "MiB after 220 runs": round(sizes[1]), "growth": growth}


def resident(parent: int) -> float:
    """MiB of a process and of its children."""
    total = 0.0
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            said = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
        except OSError:
            continue
        if int(status.parent.name) == parent or int(said["PPid"]) == parent:
            total += float(said["VmRSS"].split()[0]) / 1024
    return total


def texts() -> dict[str, object]:
    """Messages for 1,000 bad model texts: of the corpus, and parts of the example that are broken at random."""
    bad = [path.read_bytes().decode("utf-8", "replace") for path in sorted(CORPUS.rglob("*")) if path.is_file()]
    draw = random.Random(0)
    while len(bad) < 1000:
        text = list(SPIRAL)
        for _ in range(draw.randint(1, 6)):
            text[draw.randrange(len(text))] = draw.choice(list('"[]=x*(){}\n\0é9.#') + ["\u2028", "**", "e999"])
        bad.append("".join(text))
    with opened(SPIRAL, {"kind": "simulate", "until": 1, "step": 0.01, "seed": 1}) as (page, _):
        said = page.evaluate(ASK, bad[:1000])
        page.evaluate("() => window.studio.run()")
        expect(page.locator("#status")).to_contain_text("Filtered", timeout=PATIENCE)
    refused = [one for one in said if one is not None]
    return {
        "texts": len(said),
        "refused in one line": sum("\n" not in one and not one.startswith("error") for one in refused),
        "other": sum("\n" in one or one.startswith("error") for one in refused),
        "models all the same": said.count(None),
    }


if __name__ == "__main__":
    parts = {"start": start, "slider": slider, "long": long, "memory": memory, "texts": texts}
    for name in sys.argv[1:] or parts:
        print(json.dumps({name: parts[name]()}), flush=True)
