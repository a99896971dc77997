"""Drifts that take states to infinity in a finite time are distinguished from those that only grow or decay."""

import json
import math

import pytest

import zakai
from zakai.algebra.explosion import explosion


def system(*drift, **keys):
    state = ["x", "y", "z"][: len(drift)]
    return zakai.Model(state=state, drift=list(drift), observation=["x"], observation_noise=[[0.5]], **keys)


@pytest.mark.parametrize(
    ("drift", "time"),
    [
        ("x**2", lambda x: 1 / x),
        ("x**3", lambda x: 1 / (2 * x**2)),
        ("exp(x)", lambda x: math.exp(-x)),
        ("x*abs(x)", lambda x: 1 / abs(x)),
        ("x**1.5", lambda x: 2 / math.sqrt(x)),
    ],
)
def test_an_explosion_is_found_and_its_time_is_that_of_the_solution_in_closed_form(drift, time):
    found = explosion(system(drift))
    assert found.time == pytest.approx(time(found.start[0]), rel=0.05)


@pytest.mark.parametrize(
    "drift",
    [
        ("-x**3",),
        ("x**3 - x**5",),
        ("-exp(x)",),
        ("x*log(1 + x**2)",),  # faster than every exponential, and yet never at infinity
        ("x**2*sin(x)",),
        ("x**2*(1 + sin(x))",),  # comes to rest where 1 + sin(x) is zero
        ("x**3*cos(3*x)**2",),
        ("x**2*sin(y)**2", "x**2*sin(y)**2"),
        ("sqrt(400 - x**2)",),  # leaves the numbers at 20
        ("-1/x",),
        ("y", "1000*(1 - x**2)*y - x"),
        ("y**2", "-x*y"),
        ("y*z", "-2*x*z", "x*y"),
        ("5*x",),
    ],
)
def test_what_stays_finite_is_not_said_to_explode(drift):
    assert explosion(system(*drift)) is None


@pytest.mark.parametrize("name", ["dong-chen-yau-3-4", "dong-chen-yau-3-5", "dong-chen-yau-3-6"])
def test_the_examples_of_dong_chen_and_yau_explode_and_the_page_says_so(name):
    analysis = zakai.analyze(zakai.load_model(f"gallery:{name}"))
    page = str(analysis)
    assert "\nExplosion\n  the drift alone takes x = (" in page
    assert json.loads(analysis.to_json())["explosion"]["time"] == analysis.explosion.time > 0


@pytest.mark.parametrize("name", ["passive-drift", "lorenz", "silent-double-well", "wong", "benes-2d"])
def test_the_other_systems_of_the_gallery_do_not(name):
    analysis = zakai.analyze(zakai.load_model(f"gallery:{name}"))
    assert analysis.explosion is None and "Explosion" not in str(analysis)
