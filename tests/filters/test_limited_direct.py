"""The direct method against independent solutions of the Kolmogorov equation and of the filtering problem."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.kolmogorov import Box, filter_system
from references.systems import planar, scalar


def relative_error(result, reference, box, k):
    """The largest error of the normalised density, relative to its maximum."""
    expected = reference / (reference.sum() * box.cell)
    computed = np.exp(result.density(k).log_density(box.x))
    return np.abs(computed - expected).max() / expected.max()


@pytest.fixture(scope="module")
def one_state():
    system = scalar()
    box = Box(9.0, 512)
    return system, box, filter_system(box, system)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["flow", "power-series"])
def test_the_density_of_one_state_agrees_with_the_kolmogorov_equation(one_state, kernel):
    system, box, reference = one_state
    model = zakai.Model(**system.keys())
    record = zakai.Record(system.times, system.increments, "increments")
    result = zakai.filter(model, record, splitting="lie", kernel=kernel)
    assert result.method == "limited-direct" and not result.warnings
    for k in range(1, len(system.times) + 1):
        assert relative_error(result, reference[k - 1][1], box, k) <= 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["flow", pytest.param("power-series", marks=pytest.mark.longest)])
def test_the_density_of_two_states_agrees_with_the_kolmogorov_equation(kernel):
    system = planar()
    box = Box(7.0, 96, (0.0, 0.0))
    reference = filter_system(box, system)
    model = zakai.Model(**system.keys())
    record = zakai.Record(system.times, system.increments, "increments")
    result = zakai.filter(model, record, splitting="lie", kernel=kernel)
    assert not result.warnings
    for k in range(1, len(system.times) + 1):
        assert relative_error(result, reference[k - 1][1], box, k) <= 1e-9
