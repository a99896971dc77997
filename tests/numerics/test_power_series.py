"""The power-series kernel against the Kolmogorov equation itself, the Hamiltonian flow and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

import zakai
from references.flow import flow_kernel
from references.kolmogorov import Box, filter_system
from references.power_series import data, entries, kernel_of, single, texts
from references.systems import planar, scalar
from zakai.errors import ConditionError
from zakai.methods.yau.kernel import PowerSeries
from zakai.methods.yau.power import TaylorData, schroedinger, whitening
from zakai.numerics.series.power_series import derivative, product
from zakai.numerics.transition import compose

t = sympy.Symbol("t")


def series(G, L, l, Q, p, r):
    """The transitions of v_t = G:Hess v / 2 - (L x + l).grad v - (x'Q x + p.x + r) v / 2."""
    n = len(l)
    state = [f"x{i}" for i in range(n)]
    model = zakai.Model(state=state, drift=["0"] * n, observation=state)
    blocks = [sympy.sympify(entry).subs(t, model.t) for entry in entries(G, L, l, Q, p, r)]
    return PowerSeries(model, [*blocks, *blocks[2 * n * n + n :]])


def transitions(found, starts, stops):
    starts = np.asarray(starts, float)
    return found.integrate(starts, np.asarray(stops) - starts, np.zeros(0), np.zeros(found.n), False).transition


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
    inside = box.x[window]
    u = system.initial(inside)
    for k, (before, _) in enumerate(filter_system(box, system)):
        kernel = [field[k] for field in kernels]
        u = trapezoid(kernel, system, starts[k], system.times[k], u, axes, box.cell).reshape(u.shape)
        assert np.max(np.abs(u - before[window])) <= allowed * np.max(before)
        u = u * system.jump(inside, system.times[k], system.increments[k])


@pytest.mark.parametrize("system", [scalar(), planar()], ids=["one state", "two states"])
@pytest.mark.parametrize("length", [0.01, 0.1, 0.3, 0.9])
def test_the_series_and_the_hamiltonian_flow_give_one_kernel(system, length):
    kernel = kernel_of(transitions(series(*texts(system)), [0.2], [0.2 + length]))
    assert difference(kernel, flow_kernel(system, 0.2, 0.2 + length)) <= 1e-12 / min(length, 0.1)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_the_error_falls_with_the_power_after_the_order(order):
    terms = data(planar(), 0.2, 22)
    lengths = np.array([0.2, 0.1, 0.05])
    errors = [difference(single(terms, d, order)[0], single(terms, d)[0]) for d in lengths]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(lengths))
    np.testing.assert_allclose(slopes, order + 1, atol=0.4)


def test_the_remainder_bounds_the_error_of_every_order():
    terms, exact = data(planar(), 0.2, 20), flow_kernel(planar(), 0.2, 0.3)
    for order in range(1, 13):
        kernel, remainder = single(terms, 0.1, order)
        assert difference(kernel, exact) <= 10.0 * remainder + 1e-13


def test_two_halves_compose_to_the_whole():
    found = series(*texts(planar()))
    whole = compose(transitions(found, [0.2], [0.27]), transitions(found, [0.27], [0.32]))
    assert difference(kernel_of(whole), single(data(planar(), 0.2, 24), 0.12)[0]) <= 1e-12


def test_a_long_interval_is_divided_where_a_single_series_does_not_converge():
    assert single(data(planar(), 0.2, 20), 3.0)[1] > 0.1
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
    terms = data(planar(), 0.2, 14)
    G, L = terms.covariance, terms.matrix

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


def oscillator(omega):
    """v_t = v_xx / 2 - omega^2 x^2 v / 2."""
    one, zero = sympy.Matrix([[1]]), sympy.Matrix([[0]])
    return one, zero, zero, omega**2 * one, zero, zero


def test_the_remainder_does_not_depend_on_the_unit_of_time():
    terms, powers = data(planar(), 0.2, 20), np.arange(20.0)
    for unit in (1e-6, 1e6):
        scaled = TaylorData(*(field * (unit ** (-1 - powers)).reshape(-1, *[1] * (field.ndim - 1)) for field in terms))
        for order in (2, 6):
            assert single(scaled, 0.1 * unit, order)[1] == pytest.approx(single(terms, 0.1, order)[1], rel=1e-10)


def test_a_pulse_that_is_flat_at_the_start_of_an_interval_is_found():
    one, zero = sympy.Matrix([[1]]), sympy.Matrix([[0]])
    pulse = 50 * sympy.exp(-((t - sympy.Rational(37, 100)) ** 2) * 10000)
    found = transitions(series(one, zero, pulse * one, zero, zero, zero), [0.0], [1.0])
    assert found.offset.item() == pytest.approx(50 * np.sqrt(np.pi) / 100, rel=1e-10)


def test_a_singular_covariance_is_refused_in_words():
    zero, singular = np.zeros((12, 2)), np.zeros((12, 2, 2))
    singular[0, 0, 0] = 1.0
    with pytest.raises(ConditionError, match="positive definite G"):
        schroedinger(TaylorData(singular, 0 * singular, zero, singular, zero, zero[:, 0]))
