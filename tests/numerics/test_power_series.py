"""The power-series kernel against the Kolmogorov equation itself, the Hamiltonian flow and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

import zakai
from references.flow import flow_kernel
from references.kolmogorov import Box, filter_system
from references.systems import planar, scalar
from zakai.errors import ConditionError
from zakai.methods._power_series import TaylorData, power_series_kernel, taylor_data, whitening
from zakai.methods._series_kernel import PowerSeries
from zakai.methods._taylor import derivative, product
from zakai.numerics.transition import compose

t = sympy.Symbol("t")


def texts(system):
    return [sympy.Matrix(np.atleast_1d(sympy.sympify(system.yau[key]))) for key in ("G", "L", "l", "Q", "p", "r")]


def expansion(system):
    """`expand(points, terms)` of a system's texts."""
    *matrices, r = texts(system)
    return lambda points, terms: taylor_data(t, *matrices, r[0], points, terms)


def series(G, L, l, Q, p, r, order=None):
    """The transitions of v_t = G:Hess v / 2 - (L x + l).grad v - (x'Q x + p.x + r) v / 2."""
    n = len(l)
    state = [f"x{i}" for i in range(n)]
    model = zakai.Model(state=state, drift=["0"] * n, observation=state)
    blocks = [sympy.Matrix(m).subs(t, model.t) for m in (L, l, G, -Q / 2, -p / 2, -r / 2)]
    entries = [entry for block in [*blocks, *blocks[3:]] for entry in block]
    return PowerSeries(model, entries, order)


def transitions(found, starts, stops):
    starts = np.asarray(starts, float)
    return found.integrate(starts, np.asarray(stops) - starts, np.zeros(0), np.zeros(found.n), False).transition


def kernel_of(found):
    """A, B, C, D, E, s of log K(x, y) = x'A x + x'B y + y'C y + D.x + E.y + s."""
    psi, offset, noise, information, vector, constant = found
    inverse = np.linalg.inv(noise)
    B, D = inverse @ psi, inverse @ offset
    C, E = -0.5 * (information + np.swapaxes(psi, -1, -2) @ B), vector - np.swapaxes(psi, -1, -2) @ D
    s = constant - 0.5 * np.swapaxes(offset, -1, -2) @ D
    return -0.5 * inverse, B, C, D[..., 0], E[..., 0], s[..., 0, 0] - 0.5 * np.linalg.slogdet(2.0 * np.pi * noise)[1]


def difference(kernel, other):
    """The largest difference of two kernels' six coefficients."""
    return max(np.max(np.abs(np.squeeze(a) - np.squeeze(b))) for a, b in zip(kernel[:6], other[:6]))


def trapezoid(kernel, system, start, stop, u, axes, cell):
    """u after one interval: e^phi K e^-phi u, summed over the points of a regular grid."""
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, system.n)
    A, B, C, D, E, s = kernel
    ends, starts = ((points @ M * points).sum(axis=1) + points @ v for M, v in ((A, D), (C, E)))
    exponent = (ends + system.phi(points, stop))[:, None] + points @ B @ points.T + starts - system.phi(points, start) + s
    return cell * (np.exp(exponent) @ u.reshape(-1))


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
    kernels = kernel_of(transitions(series(*texts(system)), starts, system.times))
    axes, window = [axis[keep] for axis in box.axes], (keep,) * system.n
    lattice = box.x[window]
    u = system.initial(lattice)
    for k, (before, _) in enumerate(filter_system(box, system)):
        kernel = [field[k] for field in kernels]
        u = trapezoid(kernel, system, starts[k], system.times[k], u, axes, box.cell).reshape(u.shape)
        assert np.max(np.abs(u - before[window])) <= allowed * np.max(before)
        u = u * system.jump(lattice, system.times[k], system.increments[k])


@pytest.mark.parametrize("system", [scalar(), planar()], ids=["one state", "two states"])
@pytest.mark.parametrize("length", [0.01, 0.1, 0.3, 0.9])
def test_the_series_and_the_hamiltonian_flow_give_one_kernel(system, length):
    kernel = kernel_of(transitions(series(*texts(system)), [0.2], [0.2 + length]))
    assert difference(kernel, flow_kernel(system, 0.2, 0.2 + length)) <= 1e-12 / min(length, 0.1)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_the_error_falls_with_the_power_after_the_order(order):
    expand = expansion(planar())
    data = expand(np.array(0.2), 22)
    lengths = np.array([0.2, 0.1, 0.05])
    errors = [difference(power_series_kernel(data, d, order), power_series_kernel(data, d, 20)) for d in lengths]
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
    found = series(*texts(planar()))
    whole = compose(transitions(found, [0.2], [0.27]), transitions(found, [0.27], [0.32]))
    assert difference(kernel_of(whole), power_series_kernel(expand(np.array(0.2), 24), 0.12)) <= 1e-12


def test_a_long_interval_is_divided_and_a_single_series_of_it_is_refused():
    expand = expansion(planar())
    with pytest.raises(ConditionError, match="divide"):
        power_series_kernel(expand(np.array(0.2), 20), 3.0)
    found = series(*texts(planar()))
    whole = transitions(found, [0.2], [3.2])
    # One flow over the whole length loses 1e-11 of D by cancellation: the reference, too, goes in pieces.
    pieces = [transitions(found, [0.2 + k], [1.2 + k]) for k in range(3)]
    for k, piece in enumerate(pieces):
        assert difference(kernel_of(piece), flow_kernel(planar(), 0.2 + k, 1.2 + k)) <= 1e-11
    composed = compose(compose(pieces[0], pieces[1]), pieces[2])
    assert difference(kernel_of(whole), kernel_of(composed)) <= 1e-11


def test_a_batch_of_intervals_is_each_interval_by_itself():
    found = series(*texts(planar()))
    starts, stops = np.array([0.0, 0.1, 0.35, 0.41, 2.0]), np.array([0.1, 0.35, 0.41, 2.0, 2.0])
    together = transitions(found, starts, stops)
    for k in range(len(starts)):
        alone = transitions(found, starts[k : k + 1], stops[k : k + 1])
        assert all(np.array_equal(a[k], b[0]) for a, b in zip(together, alone, strict=True))


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
    A, B, *_, s = kernel_of(transitions(series(*oscillator(omega)), [0.0], [length]))
    assert A.item() == pytest.approx(-omega / 2.0 / np.tanh(1.0), rel=1e-12)
    assert B.item() == pytest.approx(omega / np.sinh(1.0), rel=1e-12)
    assert s.item() == pytest.approx(0.5 * np.log(omega / (2.0 * np.pi * np.sinh(1.0))), abs=1e-12)


@pytest.mark.parametrize(("omega", "length", "order"), [(1.0, 0.1, 7), (3.0, 0.1, 11), (10.0, 0.01, 7)])
def test_the_order_that_is_chosen_is_the_one_that_is_needed(omega, length, order):
    *matrices, r = oscillator(omega)
    kernel = power_series_kernel(taylor_data(t, *matrices, r[0], np.array(0.0), 20), length, tolerance=1e-12)
    assert abs(kernel.order - order) <= 2


def oscillator(omega):
    """v_t = v_xx / 2 - omega^2 x^2 v / 2."""
    one, zero = sympy.Matrix([[1]]), sympy.Matrix([[0]])
    return one, zero, zero, omega**2 * one, zero, zero


def test_the_remainder_does_not_depend_on_the_unit_of_time():
    expand = expansion(planar())
    data = expand(np.array(0.2), 20)
    powers = np.arange(20.0)
    for unit in (1e-6, 1e6):
        scaled = [field * (unit ** (-1 - powers)).reshape(-1, *[1] * (field.ndim - 1)) for field in data]
        one, other = power_series_kernel(data, 0.1, 6), power_series_kernel(TaylorData(*scaled), 0.1 * unit, 6)
        assert other.remainder == pytest.approx(one.remainder, rel=1e-10)
        chosen = power_series_kernel(data, 0.1), power_series_kernel(TaylorData(*scaled), 0.1 * unit)
        assert chosen[0].order == chosen[1].order


def test_a_pulse_that_is_flat_at_the_start_of_an_interval_is_found():
    one, zero = sympy.Matrix([[1]]), sympy.Matrix([[0]])
    pulse = 50 * sympy.exp(-((t - sympy.Rational(37, 100)) ** 2) * 10000)
    found = transitions(series(one, zero, pulse * one, zero, zero, zero), [0.0], [1.0])
    assert found.offset.item() == pytest.approx(50 * np.sqrt(np.pi) / 100, rel=1e-10)


def test_a_singular_covariance_is_refused_in_words():
    zero, singular = np.zeros((12, 2)), np.zeros((12, 2, 2))
    singular[0, 0, 0] = 1.0
    with pytest.raises(ConditionError, match="positive definite G"):
        power_series_kernel(TaylorData(singular, 0 * singular, zero, singular, zero, zero[:, 0]), 0.1)
