"""Time of the picture of a density over time: its frames, and what a browser needs to draw them.

    python benchmarks/pictures.py [--observations 100000] [--chromium /usr/bin/chromium]

`frame_ms`: processor time of `picture_bytes`, of all times and of a window; `frame_kB`: the sizes.  `draw_ms`: processor time of
the page's main thread in Chromium, which runs the script and, without a graphics card, draws, for each of 60 steps: a zoom to 100
observations and a move along the record; a picture of 1,280 by 360 pixels.  Playwright (the extra `dev`) drives the browser.
Expected: no step above 100 ms.
"""

from __future__ import annotations

import argparse
import base64
import json
import time
from typing import Any

import numpy as np

import zakai
from zakai.report.picture import picture_bytes
from zakai.report.scripts import bundle

START = """([whole]) => {
  window.bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  window.drawn = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))));
  window.view = new $density.DensityView(document.body.appendChild(document.createElement("div")));
  view.setFrame(bytes(whole));
  return drawn();
}"""
STEPS = 30


def measured(call: Any) -> tuple[float, bytes]:
    """The least processor time of three calls in milliseconds, and what they return."""
    spent = []
    for _ in range(3):
        begin = time.process_time()
        frame = call()
        spent.append(1e3 * (time.process_time() - begin))
    return round(min(spent), 1), frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=100_000)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    arguments = parser.parse_args()
    model = zakai.load_model("gallery:cubic-sensor")
    truth, record = zakai.simulate(model, 0.01 * np.arange(1, arguments.observations + 1), seed=0)
    result = zakai.filter(model, record, keep="densities")
    middle = 0.5 * float(result.times[-1])
    whole_ms, whole = measured(lambda: picture_bytes(result, truth=truth))
    window_ms, part = measured(lambda: picture_bytes(result, window=(middle - 5.0, middle + 5.0), truth=truth))
    few_ms, few = measured(lambda: picture_bytes(result, columns=400, rows=128))
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=arguments.chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_script_tag(content=bundle("page").replace("const $density", "var $density"))
        whole_text, part_text = (base64.b64encode(frame).decode() for frame in (whole, part))
        page.evaluate(START, [whole_text])
        metrics = page.context.new_cdp_session(page)
        metrics.send("Performance.enable", {"timeDomain": "threadTicks"})

        def busy() -> float:
            found = {one["name"]: one["value"] for one in metrics.send("Performance.getMetrics")["metrics"]}
            return 1e3 * found["TaskDuration"]

        factor = (100 / arguments.observations) ** (1 / STEPS)
        steps = [f"view.zoom('x', {factor}, {middle})"] * STEPS + [
            f"view.pan('x', {0.3 if k % 2 else -0.2})" for k in range(STEPS)
        ]
        spent = []
        for k, step in enumerate(steps):
            if k == STEPS:
                page.evaluate("(text) => { view.setFrame(bytes(text)); return drawn(); }", part_text)
            before = busy()
            page.evaluate(f"() => {{ {step}; return drawn(); }}")
            spent.append(busy() - before)
        browser.close()
    frames = {
        "all times": (whole_ms, whole),
        "1,000 times of a window": (window_ms, part),
        "400 columns of 128 cells": (few_ms, few),
    }
    figures = {
        "observations": arguments.observations,
        "frame_ms": {name: ms for name, (ms, _) in frames.items()},
        "frame_kB": {name: round(len(frame) / 1e3) for name, (_, frame) in frames.items()},
        "draw_ms": {"median": round(float(np.median(spent)), 1), "largest": round(max(spent), 1)},
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
