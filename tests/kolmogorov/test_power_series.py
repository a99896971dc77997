"""The power-series kernel against the Kolmogorov equation itself, the Hamiltonian flow and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from references.flow import flow_kernel
from references.kolmogorov import Box, filter_system
from references.systems import planar, scalar
from zakai.errors import ConditionError
from zakai.kolmogorov.power_series import (
    KernelCoefficients,
    TaylorData,
    compose,
    log_kernel,
    power_series_kernel,
    power_series_kernels,
    taylor_data,
)
from zakai.kolmogorov.schroedinger import whitening
from zakai.kolmogorov.taylor import derivative, product

t = sympy.Symbol("t")


def expansion(system):
    """`expand(points, terms)` of a system's texts, as `power_series_kernels` wants it."""
    texts = [sympy.Matrix(sympy.sympify(system.yau[key])) for key in ("G", "L", "l", "Q", "p")]
    r = sympy.sympify(system.yau["r"])
    return lambda points, terms: taylor_data(t, *texts, r, points, terms)


def difference(kernel, other):
    """The largest difference of two kernels' six coefficients."""
    return max(np.max(np.abs(np.squeeze(a) - np.squeeze(b))) for a, b in zip(kernel[:6], other[:6]))


def trapezoid(kernel, system, start, stop, u, axes, cell):
    """u after one interval: e^phi K e^-phi u, summed over the points of a regular lattice, in log domain."""
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, system.n)
    u = u.reshape(-1)
    exponent = (
        log_kernel(kernel, points, points) + system.phi(points, stop)[:, None] - system.phi(points, start)
    )
    return cell * (np.exp(exponent) @ u)


@pytest.mark.parametrize(
    ("system", "half_width", "points", "keep", "allowed"),
    [(scalar(), 12.0, 256, slice(None), 1e-10), (planar(), 9.0, 96, slice(14, 82), 1e-9)],
    ids=["one state", "two states"],
)
def test_the_series_gives_the_density_of_an_independent_solution_through_every_interval(
    system, half_width, points, keep, allowed
):
    box = Box(half_width, points, np.zeros(system.n))
    starts = np.r_[system.start, system.times[:-1]]
    kernels = power_series_kernels(expansion(system), starts, system.times)
    axes, window = [axis[keep] for axis in box.axes], (keep,) * system.n
    lattice = box.x[window]
    u = system.initial(lattice)
    for k, (before, _) in enumerate(filter_system(box, system)):
        u = trapezoid(kernels.part(k), system, starts[k], system.times[k], u, axes, box.cell).reshape(u.shape)
        assert np.max(np.abs(u - before[window])) <= allowed * np.max(before)
        u = u * system.jump(lattice, system.times[k], system.increments[k])


@pytest.mark.parametrize("system", [scalar(), planar()], ids=["one state", "two states"])
@pytest.mark.parametrize("length", [0.01, 0.1, 0.3, 0.9])
def test_the_series_and_the_hamiltonian_flow_give_one_kernel(system, length):
    kernel = power_series_kernels(expansion(system), np.array([0.2]), np.array([0.2 + length]))
    assert difference(kernel, flow_kernel(system, 0.2, 0.2 + length)) <= 1e-12 / min(length, 0.1)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_the_error_falls_with_the_power_after_the_order(order):
    expand = expansion(planar())
    data = expand(np.array(0.2), 22)
    lengths = np.array([0.2, 0.1, 0.05])
    errors = [
        difference(power_series_kernel(data, d, order), power_series_kernel(data, d, 20)) for d in lengths
    ]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(lengths))
    np.testing.assert_allclose(slopes, order + 1, atol=0.4)


def test_the_remainder_bounds_the_error_of_every_order():
    data, exact = expansion(planar())(np.array(0.2), 20), flow_kernel(planar(), 0.2, 0.3)
    for order in range(1, 13):
        kernel = power_series_kernel(data, 0.1, order)
        assert kernel.order == order
        assert difference(kernel, exact) <= 10.0 * kernel.remainder + 1e-13


def test_two_halves_compose_to_the_whole():
    expand = expansion(planar())
    first = power_series_kernel(expand(np.array(0.2), 20), 0.07)
    second = power_series_kernel(expand(np.array(0.27), 20), 0.05)
    assert difference(compose(second, first), power_series_kernel(expand(np.array(0.2), 24), 0.12)) <= 1e-12


def test_a_long_interval_is_divided_and_a_single_series_of_it_is_refused():
    expand = expansion(planar())
    with pytest.raises(ConditionError, match="divide"):
        power_series_kernel(expand(np.array(0.2), 20), 3.0)
    kernel = power_series_kernels(expand, np.array([0.2]), np.array([3.2]))
    # One flow over the whole length loses 1e-11 of D by cancellation: the reference, too, goes in pieces.
    pieces = [KernelCoefficients(*flow_kernel(planar(), 0.2 + k, 1.2 + k), 0, np.zeros(())) for k in range(3)]
    assert difference(kernel, compose(pieces[2], compose(pieces[1], pieces[0]))) <= 1e-12


def test_a_batch_of_intervals_is_each_interval_by_itself():
    expand = expansion(planar())
    starts, stops = np.array([0.0, 0.1, 0.35]), np.array([0.1, 0.35, 0.41])
    together = power_series_kernels(expand, starts, stops)
    for k in range(3):
        alone = power_series_kernels(expand, starts[k : k + 1], stops[k : k + 1])
        assert difference(together.part(k), alone) <= 1e-12


def test_omega_is_symmetric_for_a_drift_that_the_cholesky_factor_does_not_fit():
    data = expansion(planar())(np.array(0.2), 14)
    G, L = data.covariance, data.matrix

    def antisymmetric(F, B):
        in_z = product(B, product(L, F))[:-1] - product(B, derivative(F))
        return np.max(np.abs(in_z - np.swapaxes(in_z, -1, -2)))

    F, B = whitening(G, L)
    np.testing.assert_allclose(product(F, np.swapaxes(F, -1, -2)), G, atol=1e-13)
    assert antisymmetric(F, B) <= 1e-13
    F, B = whitening(G, 0.0 * L)  # a factor of G that does not know this L
    assert antisymmetric(F, B) >= 0.1


@pytest.mark.parametrize("omega", [1.0, 3.0, 10.0])
def test_mehlers_kernel_is_reproduced_in_time_that_suits_its_frequency(omega):
    length = 1.0 / omega
    kernel = power_series_kernels(oscillator(omega), np.array([0.0]), np.array([length]))
    assert kernel.A.item() == pytest.approx(-omega / 2.0 / np.tanh(1.0), rel=1e-12)
    assert kernel.B.item() == pytest.approx(omega / np.sinh(1.0), rel=1e-12)
    assert kernel.s.item() == pytest.approx(0.5 * np.log(omega / (2.0 * np.pi * np.sinh(1.0))), abs=1e-12)


@pytest.mark.parametrize(("omega", "length", "order"), [(1.0, 0.1, 7), (3.0, 0.1, 11), (10.0, 0.01, 7)])
def test_the_order_that_is_chosen_is_the_one_that_is_needed(omega, length, order):
    kernel = power_series_kernels(oscillator(omega), np.array([0.0]), np.array([length]), tolerance=1e-12)
    assert abs(kernel.order - order) <= 2


def oscillator(omega):
    """v_t = v_xx / 2 - omega^2 x^2 v / 2."""
    one, zero = sympy.Matrix([[1]]), sympy.Matrix([[0]])
    return lambda points, terms: taylor_data(
        t, one, zero, zero, omega**2 * one, zero, sympy.Integer(0), points, terms
    )


def test_a_singular_covariance_is_refused_in_words():
    zero, singular = np.zeros((12, 2)), np.zeros((12, 2, 2))
    singular[0, 0, 0] = 1.0
    with pytest.raises(ConditionError, match="positive definite G"):
        power_series_kernel(TaylorData(singular, 0 * singular, zero, singular, zero, zero[:, 0]), 0.1)
