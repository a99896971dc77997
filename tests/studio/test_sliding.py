"""While a parameter is dragged the page sees what the filter gives at the new values, at a coarse tolerance."""

from __future__ import annotations

import tomllib
from decimal import Decimal

import numpy as np
import pytest

import zakai
from report.frames import read
from zakai.studio.session import Session
from zakai.studio.tasks import carried_out

DATA = {"kind": "simulate", "until": 2.0, "step": 0.1, "seed": 3}
WELLS = """
state = ["x"]
drift = ["a*(x - x**3)"]
observation = ["x**2 + x/5"]
observation_noise = [["r**2"]]
observation_kind = "samples"
[parameters]
a = 1.0
r = 0.6
[prior]
kind = "gaussian"
mean = [0.0]
cov = [[1.0]]
"""
BLOCKS = """
state = ["x", "y"]
drift = ["a*(x - x**3)", "b*(y - y**3)"]
observation = ["x", "y"]
observation_noise = [["0.2", "0"], ["0", "0.2"]]
observation_kind = "samples"
[parameters]
a = 1.0
b = 1.0
[prior]
kind = "gaussian"
mean = [0.0, 0.0]
cov = [[1.0, 0.0], [0.0, 1.0]]
"""
MOVING = WELLS.replace('"r**2"', '"r - sin(t)/2"')
INCREMENTS = WELLS.replace("samples", "increments").replace('"r**2"', '"1"').replace("r = 0.6\n", "")
ENDS = '[domain]\nx = { lower = -2.0, upper = 2.0, boundary = "reflecting" }\n[parameters]'
BOUNDED = WELLS.replace("[parameters]", ENDS).replace("1.0]]", "0.05]]")
FORMULA = WELLS.replace('kind = "gaussian"\nmean = [0.0]\ncov = [[1.0]]', 'kind = "density"\nlog_density = "-a*x**2"')


def model_of(text: str) -> zakai.Model:
    return zakai.Model(**tomllib.loads(text, parse_float=Decimal))


@pytest.fixture
def ask(tmp_path):
    session = Session(tmp_path)

    def asked(do: str, **rest):
        return carried_out(session, {"do": do, "data": DATA, **rest}, lambda *_: None)

    return asked


@pytest.mark.parametrize("text", [WELLS, BLOCKS, MOVING, INCREMENTS, BOUNDED, FORMULA])
def test_a_dragged_value_gives_what_the_filter_gives(ask, text: str):
    ask("run", text=text)
    model = model_of(text)
    _, record = zakai.simulate(model, np.arange(1, 21) * 0.1, seed=3)
    for value in (0.4, 2.5):
        header, arrays = ask("slide", text=text, values={"a": value})
        expected = zakai.filter(model.with_parameters(a=value), record, tolerance=1e-2)
        assert header["log_likelihood"] == pytest.approx(expected.log_likelihood, abs=1e-9)
        frame, drawn = read(arrays["frame"].tobytes())
        assert frame["name"] == model.state[0]
        assert np.allclose(drawn["mean"], expected.mean[:, 0], rtol=0, atol=1e-9)


def test_dragging_takes_fewer_particles_than_the_result_has(ask):
    circling = BLOCKS.replace("a*(x - x**3)", "a*y").replace("b*(y - y**3)", "-b*sin(x)")
    ask("run", text=circling, method="guided-particles")
    header, _ = ask("slide", text=circling, method="guided-particles", values={"a": 1.1})
    _, record = zakai.simulate(model_of(circling), np.arange(1, 21) * 0.1, seed=3)
    expected = zakai.filter(model_of(circling).with_parameters(a=1.1), record, "guided-particles", tolerance=0.09)
    assert header["log_likelihood"] == pytest.approx(expected.log_likelihood, abs=1e-9)


@pytest.mark.parametrize(("text", "value"), [(WELLS, 0.0), (MOVING, 0.3)])
def test_a_value_at_which_a_noise_is_none_is_refused(ask, text: str, value: float):
    ask("run", text=text)
    with pytest.raises(zakai.InputError, match="observation_noise: is not positive definite"):
        ask("slide", text=text, values={"r": value})


def test_of_a_long_record_only_the_rows_that_are_seen_are_filtered(ask):
    data = {**DATA, "until": 850.0, "step": 0.25}
    ask("run", text=WELLS, data=data)
    _, record = zakai.simulate(model_of(WELLS), np.arange(1, 3401) * 0.25, seed=3)
    expected = zakai.filter(model_of(WELLS).with_parameters(a=1.2), record, tolerance=1e-2)
    header, arrays = ask("slide", text=WELLS, data=data, values={"a": 1.2}, columns=100, **{"from": 820.0, "to": 830.0})
    assert header["log_likelihood"] is None
    frame, drawn = read(arrays["frame"].tobytes())
    assert frame["extent"] == [0.0, 850.0]
    assert len(drawn["times"]) <= 100 and drawn["times"][0] <= 820 and drawn["times"][-1] >= 830
    means = np.interp(drawn["times"], expected.times, expected.mean[:, 0])
    assert np.allclose(drawn["mean"], means, rtol=0, atol=0.05)
