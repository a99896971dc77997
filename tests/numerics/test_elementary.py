"""Elementary functions of rows against the C library in a wider type, and what they make of special numbers."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.methods.particles.interval import Motion
from zakai.methods.particles.system import system_of

SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-310, -1e-310, 1e308, -1e308, 710.0, -745.0, 1e9])
ONE = {
    "exp(x)": (np.exp, -700, 700), "log(x)": (np.log, 1e-9, 5), "sin(x)": (np.sin, -40, 40), "cos(x)": (np.cos, -4e4, 4e4),
    "tanh(x)": (np.tanh, -4, 4), "atan(x)": (np.arctan, -9, 9), "sqrt(x)": (np.sqrt, 0, 9), "abs(x)": (np.abs, -9, 9),
    "floor(x)": (np.floor, -9, 9), "x**2": (np.square, -9, 9), "x**3": (lambda x: x * x * x, -9, 9),
    "x**4": (lambda x: (x * x) * (x * x), -9, 9), "atan2(x, y)": (np.arctan2, -9, 9),
}  # fmt: skip


def computed(formula, x, y):
    model = zakai.Model(
        state=["x", "y"], drift=[formula, "0"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )  # fmt: skip
    motion = Motion(system_of(model), model.theta())
    return motion.values(motion.arrays[0], np.array([x, y]), 0.0, np.zeros(0))[0]


@pytest.mark.parametrize("formula", ONE)
def test_a_row_is_right_to_two_units_in_the_last_place(formula):
    function, low, high = ONE[formula]
    x, y = np.random.default_rng(0).uniform(low, high, (2, 5000))
    x[:2500] *= 1e-3
    wide = np.longdouble(x), np.longdouble(y)
    with np.errstate(all="ignore"):
        expected = function(*wide) if "y" in formula else function(wide[0])
    assert np.all(np.abs(computed(formula, x, y) - expected) <= 2 * np.spacing(np.abs(expected.astype(float))))


@pytest.mark.parametrize("formula", ONE)
def test_special_numbers_give_what_the_c_library_gives(formula):
    function = ONE[formula][0]
    x, y = (grid.ravel() for grid in np.meshgrid(SPECIAL, SPECIAL))
    with np.errstate(all="ignore"):
        expected, found = function(x, y) if "y" in formula else function(x), computed(formula, x, y)
    assert np.allclose(found, expected, rtol=4e-16, atol=0, equal_nan=True)
    known = ~np.isnan(expected) & ((expected != 0) | ("atan" in formula))
    assert np.array_equal(np.signbit(found[known]), np.signbit(expected[known]))
