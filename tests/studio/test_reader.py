"""What a reader of the studio sees of own records, of long computations and of a forecast, in a real browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import zakai
from studio.test_browser import PATIENCE, address, expect_status, likelihood, page, replace  # noqa: F401

INPUT = ('observation = ["x**2 + c*x"]', 'observation = ["x**2 + c*x"]\ninputs = ["u"]')
LONG = 'text => { studio.load(text, { kind: "simulate", until: 200, step: 0.01, seed: 0 }); }'
SHADE = """([x, y]) => {
  const view = studio.result.view, { ratio } = view, at = (value) => Math.round(ratio * value);
  return [...view.canvas.getContext("2d").getImageData(at(view.px(x)), at(view.py(y)), 1, 1).data].slice(0, 3);
}"""


def upload(page: Page, path: Path) -> None:  # noqa: F811
    page.get_by_test_id("data-file").click()
    page.get_by_test_id("record-file").set_input_files(path)


def test_columns_are_chosen_where_no_name_says_which_they_are(page: Page, tmp_path: Path):  # noqa: F811
    replace(page, "a*(x - x**3)", "a*(x - x**3) + u")
    replace(page, *INPUT)
    expect(page.get_by_test_id("model-error")).to_be_hidden()
    rows = [(0.1 * k, np.sin(k) + 1.0, np.cos(k) / 5, 21.5) for k in range(1, 31)]
    lines = [";".join(f"{value:.4f}".replace(".", ",") for value in row) for row in rows]
    (tmp_path / "mine.csv").write_text("\n".join(["time;Spannung;Strom;Temperatur", *lines]) + "\n")
    upload(page, tmp_path / "mine.csv")
    expect(page.get_by_test_id("data-error")).to_have_text("Choose the column of y1, u.")
    page.get_by_test_id("column-y1").select_option("Spannung")
    expect(page.get_by_test_id("data-error")).to_have_text("Choose the column of u.")
    page.get_by_test_id("column-u").select_option("Strom")
    expect(page.get_by_test_id("data-error")).to_be_hidden()
    expect(page.get_by_test_id("fact-observations")).to_have_text("30", timeout=PATIENCE)
    (tmp_path / "model.toml").write_text(page.get_by_test_id("model-text").input_value())
    model, table = zakai.load_model(tmp_path / "model.toml"), np.round(np.array(rows), 4)
    inputs = zakai.Inputs.of_rows(table[:, 0], table[:, 2:3])
    expected = zakai.filter(model, zakai.Record(table[:, 0], table[:, 1:2], "samples", inputs)).log_likelihood
    assert float(likelihood(page).replace("−", "-")) == pytest.approx(expected, rel=1e-6)


def test_a_gap_is_said_and_has_no_density(page: Page, tmp_path: Path):  # noqa: F811
    times = [0.1 * k for k in range(1, 101) if not 40 < k < 60]
    (tmp_path / "gap.csv").write_text("time,z\n" + "".join(f"{time:.1f},1.0\n" for time in times))
    upload(page, tmp_path / "gap.csv")
    facts = page.get_by_test_id("data-facts")
    expect(facts).to_contain_text("the longest interval is 2, after 4")
    expect(facts).to_contain_text("no missing values")
    expect(page.get_by_test_id("fact-observations")).to_have_text("81")
    expect_status(page, "Filtered 81")
    page.wait_for_timeout(300)
    column = [page.evaluate(SHADE, [4.7, 0.02 * k]) for k in range(-60, 60)]
    before = [page.evaluate(SHADE, [3.5, 0.02 * k]) for k in range(-60, 60)]
    assert sum(min(pixel) == 255 for pixel in before) < 90  # shaded
    assert sum(min(pixel) == 255 for pixel in column) > 100  # nothing but lines


def test_another_model_ends_a_run_that_takes_long(page: Page):  # noqa: F811
    page.evaluate(LONG, zakai.gallery.text("lorenz"))
    expect(page.locator("body.busy")).to_have_count(1)
    page.wait_for_timeout(1500)
    page.get_by_test_id("gallery").select_option("*")
    expect(page.locator("#status")).to_contain_text("Filtered 600", timeout=20_000)


def test_a_computation_beside_a_run_can_be_cancelled(page: Page):  # noqa: F811
    page.evaluate("() => { studio.link.ask = () => new Promise(() => {}); }")
    expect(page.get_by_test_id("cancel")).to_be_hidden()
    page.get_by_test_id("tab-residuals").click()
    expect(page.get_by_test_id("cancel")).to_be_visible()


def test_a_picture_that_takes_long_is_said(page: Page):  # noqa: F811
    page.evaluate("""() => {
      const ask = studio.link.ask.bind(studio.link);
      studio.link.ask = (what, ...rest) => (what === "picture" ? new Promise(() => {}) : ask(what, ...rest));
      studio.run();
    }""")
    expect_status(page, "Drawing the density")
    expect(page.get_by_test_id("cancel")).to_be_visible()


def test_a_forecast_has_no_likelihood(page: Page):  # noqa: F811
    page.get_by_test_id("show-forecast").click()
    expect(page.locator("#verdict")).to_contain_text("forecast 100 times without observations")
    expect(page.get_by_test_id("fact-log-likelihood")).to_have_count(0)
    expect(page.get_by_test_id("fact-times")).to_have_text("100")


def test_another_option_of_a_method_is_used_at_once(page: Page):  # noqa: F811
    option = page.get_by_test_id("option-tolerance")
    option.fill("-1")
    option.press("Enter")
    expect_status(page, "tolerance")


def test_names_of_parameters_leave_all_sliders_of_one_length(page: Page):  # noqa: F811
    replace(page, "a = 1.0", "a = 1.0\ncapacity_of_it = 2.0")
    expect(page.get_by_test_id("slider-capacity_of_it")).to_be_visible()
    ends = {page.get_by_test_id(f"slider-{name}").bounding_box()["width"] for name in ("a", "capacity_of_it", "r")}
    assert max(ends) - min(ends) < 1


def test_a_task_beside_another_one_says_that_it_has_to_wait(page: Page):  # noqa: F811
    page.evaluate("() => { studio.link.ask = () => new Promise(() => {}); }")
    page.get_by_test_id("fit").click()
    expect(page.locator("#status")).to_have_text("Fitting …")
    page.get_by_test_id("profile").click()
    expect(page.locator("#status")).to_contain_text("Fitting … It has not ended; press Cancel to end it.")
