"""Exponentials of the Kolmogorov operator on panels, against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from zakai.numerics.line.rational import COLLOCATION, CONTRACTION, Factors, collocated, joined, separated, weak_form
from zakai.numerics.lobatto import Element

ELEMENT = Element(-3.0, 4.0, 9, tuple(np.linspace(-3.0, 4.0, 31)[1:-1].tolist()))
ONE = np.ones(len(ELEMENT.halves))


def parts(t=0.0, a=1.0):
    x = ELEMENT.points
    return weak_form(ELEMENT, 0.5 + 0.1 * x**2, -a * x * np.abs(x) + np.sin(3.0 * t), -0.2 * x**2, ONE)


def dense(blocks):
    result, last = np.zeros((len(ELEMENT.halves) * 8 + 1,) * 2, blocks.dtype), ELEMENT.size - 1
    for q, block in enumerate(blocks):
        result[q * last : (q + 1) * last + 1, q * last : (q + 1) * last + 1] += block
    return result


def start():
    return joined(ELEMENT, ELEMENT.weights * np.exp(-2.0 * (ELEMENT.points - 0.5) ** 2))


@pytest.mark.parametrize("backward", [False, True])
def test_the_exponential_is_that_of_the_matrix(backward):
    blocks = parts().swapaxes(-1, -2) if backward else parts()
    values = start() / np.max(start())
    found = Factors.of(ELEMENT, 0.3 * blocks, CONTRACTION.values).exponential(np.stack([values, 2.0 * values]))
    expected = expm(0.3 * dense(blocks)) @ values
    assert found == pytest.approx(np.stack([expected, 2.0 * expected]), abs=1e-10)


def test_the_weak_form_keeps_the_mass_and_has_the_density_of_detailed_balance():
    x = ELEMENT.points
    blocks = weak_form(ELEMENT, np.ones_like(x), -x, 0.0 * x, ONE)
    masses = joined(ELEMENT, ELEMENT.weights * np.exp(-(x**2)))
    assert np.abs(dense(blocks).sum(axis=0)).max() < 1e-9
    assert np.abs(dense(blocks) @ masses).max() < 1e-6 * np.abs(dense(blocks)).max() * masses.max()


def test_collocation_follows_coefficients_of_time():
    step = 0.05
    found = collocated(ELEMENT, step * np.stack([parts(step * node) for node in COLLOCATION.nodes]), start())
    coarse, fine = start(), start()
    for k in range(100):
        coarse = expm(step / 100 * dense(parts(step * (k + 0.5) / 100))) @ coarse
    for k in range(200):
        fine = expm(step / 200 * dense(parts(step * (k + 0.5) / 200))) @ fine
    assert found == pytest.approx(fine + (fine - coarse) / 3.0, abs=1e-6 * fine.max())


@pytest.mark.parametrize("varying", [False, True])
def test_complex_coefficients_carry_derivatives(varying):
    def after(a):
        if not varying:
            return Factors.of(ELEMENT, 0.1 * parts(0.0, a), CONTRACTION.values).exponential(start() * a)
        return collocated(ELEMENT, 0.1 * np.stack([parts(0.1 * node, a) for node in COLLOCATION.nodes]), start() * a)

    step = 1e-4
    difference = (after(1.0 + step) - after(1.0 - step)) / (2.0 * step)
    assert after(1.0 + 1e-150j).imag / 1e-150 == pytest.approx(difference, abs=1e-6)


def test_values_at_shared_ends_of_panels_are_those_of_both():
    values = np.arange(len(ELEMENT.halves) * 8 + 1.0)
    apart = separated(ELEMENT, values).reshape(-1, ELEMENT.size)
    assert np.array_equal(apart[1:, 0], apart[:-1, -1])
    assert joined(ELEMENT, apart.reshape(-1))[8::8][:-1] == pytest.approx(2.0 * values[8::8][:-1])
