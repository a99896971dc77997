"""The Kolmogorov forward equation on a lattice that moves: against exact laws and an independent solver."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from references.kolmogorov import Box, propagate
from zakai.kolmogorov import comoving
from zakai.kolmogorov.comoving import Field

A = np.array([[-0.3, 1.0], [-1.0, -0.2]])
NOISE = np.array([[1.0, 0.3], [0.3, 0.5]])
MEAN, COV = np.array([0.5, -0.2]), 0.3 * np.array([[1.0, 0.5], [0.5, 0.8]])


def gaussian(mean, cov, size: int, basis) -> Field:
    z = np.stack(np.meshgrid(*[np.arange(size) - size // 2] * len(mean), indexing="ij"), axis=-1) @ np.asarray(basis).T
    logs = -0.5 * np.einsum("...i,ij,...j", z, np.linalg.inv(cov), z)
    return Field(jnp.exp(logs), jnp.asarray(mean), jnp.asarray(basis))


def moments(field: Field) -> tuple[np.ndarray, np.ndarray]:
    _, mean, cov = comoving.moments(field.values)
    return np.asarray(field.centre + field.basis @ mean), np.asarray(field.basis @ cov @ field.basis.T)


def linear(x, t):
    return tuple(A[i, 0] * x[..., 0] + A[i, 1] * x[..., 1] for i in range(2))


def stepped(field: Field, drift, noise, until: float, steps: int, **options) -> Field:
    step = jax.jit(lambda field, t: comoving.moved(field, drift, lambda t: jnp.asarray(noise), t, until / steps, **options)[0])
    for k in range(steps):
        field = step(field, k * until / steps)
    return field


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize(("order", "least"), [(4, 14.0), (2, 3.6)])
def test_a_gaussian_stays_one_with_the_moments_of_its_equation_and_the_error_falls_as_the_order_says(follow, order, least):
    flow = expm(0.2 * A)
    both = expm(0.2 * np.block([[A, NOISE], [np.zeros((2, 2)), -A.T]]))
    mean, cov = flow @ MEAN, flow @ COV @ flow.T + both[:2, 2:] @ both[:2, :2].T
    errors = []
    for steps in (4, 8):
        field = gaussian(MEAN, COV, 48, np.linalg.cholesky(COV) / 2.4)
        got = moments(stepped(field, linear, NOISE, 0.2, steps, order=order, follow=follow, cross=True))
        errors.append(max(np.abs(got[0] - mean).max(), np.abs(got[1] - cov).max()))
    assert errors[0] / errors[1] > least
    assert errors[1] < (3e-8 if order == 4 else 1e-3)


@pytest.mark.parametrize("follow", [False, True])
def test_many_wells_against_an_independent_solver(follow):
    box = Box(7.0, 192)
    x = box.x[..., 0]
    exact = propagate(
        box,
        np.exp(-((x - 0.6) ** 2) / 0.5),
        0.0,
        0.4,
        lambda x, t: 1.5 * np.sin(2 * x),
        lambda x, t: 3.0 * np.cos(2 * x[..., 0]),
        lambda t: np.array([[0.7]]),
        lambda x, t: np.zeros(x.shape[:-1]),
        1e-12,
    )
    start = gaussian(np.array([0.6]), np.array([[0.25]]), 128, np.array([[0.08]]))
    end = stepped(start, lambda x, t: (1.5 * jnp.sin(2 * x[..., 0]),), [[0.7]], 0.4, 64, follow=follow)
    values = np.asarray(end.values / jnp.sum(end.values) / end.basis[0, 0])
    at = np.asarray(end.points())[:, 0]
    # The trigonometric interpolant of the reference, at the points of the lattice.
    size = len(x)
    spectrum = np.fft.fft(exact) / size
    frequency = np.fft.fftfreq(size, 1 / size)
    exact_at = np.real(np.exp(2j * np.pi * np.outer((at + 7.0) / 14.0, frequency)) @ spectrum) / (exact.sum() * box.cell)
    inside = np.abs(at) < 6.5
    assert np.abs(values - exact_at)[inside].max() < 1e-7 * exact_at.max()


def test_a_lattice_that_is_laid_anew_shows_the_same_density_without_correlations():
    cov = np.array([[1.0, 0.5, -0.2], [0.5, 0.8, 0.1], [-0.2, 0.1, 0.6]])
    field = gaussian(np.array([1.0, 2.0, -1.0]), cov, 44, 0.4 * np.eye(3))
    anew = comoving.relaid(field, 6.5)
    for got, expected in zip(moments(anew), moments(field), strict=True):
        assert np.allclose(got, expected, rtol=0, atol=1e-5)
    own = np.asarray(comoving.moments(anew.values).cov)
    assert np.allclose(own, own[0, 0] * np.eye(3), rtol=0, atol=1e-5 * own[0, 0])
    assert np.isclose(np.sqrt(own[0, 0]) * 6.5, 21.0, rtol=1e-5)


def test_mass_stays_whatever_the_drift():
    field = gaussian(np.array([0.3]), np.array([[0.5]]), 64, np.array([[0.2]]))
    end, _ = comoving.moved(field, lambda x, t: (jnp.sin(3 * x[..., 0]) - t,), lambda t: jnp.array([[1.0]]), 0.5, 0.01)
    assert np.isclose(jnp.sum(end.values), jnp.sum(field.values), rtol=1e-13)


@pytest.mark.parametrize("order", [2, 4])
def test_a_lattice_that_is_aligned_with_the_coordinates_gives_the_same(order):
    def drift(x, t):
        return [jnp.cos(x[..., 1]) - x[..., 0], jnp.sin(x[..., 0]) * (1.0 + t) + 0.0 * x[..., 1]]

    def noise(t):
        return jnp.diag(jnp.array([1.0 + t, 0.5]))

    index = np.stack(np.meshgrid(np.arange(24.0) - 12, np.arange(36.0) - 18, indexing="ij"))
    values = jnp.exp(-(index[0] ** 2 / 14 + (index[1] - 2) ** 2 / 40))
    field = Field(values, jnp.array([0.3, -1.0]), jnp.diag(jnp.array([0.2, 0.1])))
    results = [comoving.moved(field, drift, noise, 0.5, 0.02, order, aligned=own) for own in (False, True)]
    (turned, error), (aligned, same) = results
    np.testing.assert_allclose(aligned.values, turned.values, rtol=0, atol=1e-13)
    np.testing.assert_allclose(aligned.centre, turned.centre, rtol=1e-14)
    assert float(same) == pytest.approx(float(error), rel=1e-6)
    assert np.asarray(field.points()[1::2, ::3]).shape == field.points(aligned=True)[1::2, ::3].shape == (12, 12, 2)


@pytest.mark.parametrize(("order", "least"), [(2, 0.5), (4, 0.5), (4, 0.0)])
def test_along_an_axis_without_noise_the_lattice_goes_by_whole_cells(order, least):
    flow, noise = np.array([[0.0, 1.0], [-1.0, -0.2]]), np.diag([0.0, least])
    mean, cov, until, steps = np.array([0.5, 3.0]), np.diag([0.3, 0.2]), 0.2, 16

    def drift(x, t):
        return [x[..., 1] + 0.0 * x[..., 0], -x[..., 0] - 0.2 * x[..., 1]]

    # The mean is 3.4 cells and 1.6 from the centre.
    cell = np.sqrt(np.diag(cov)) / 2.4
    field = gaussian([0.0, 0.0], cov, 48, np.diag(cell))
    start = field._replace(values=jnp.roll(field.values, (3, 2), (0, 1)), centre=jnp.asarray(mean - cell * [3, 2]))
    fields = []
    for quiet in ((), (0,) if least else (0, 1)):
        step = jax.jit(
            lambda field, quiet=quiet: comoving.moved(
                field, drift, lambda t: jnp.asarray(noise), 0.0, until / steps, order, aligned=True, quiet=quiet
            )[0]
        )
        field = start
        for _ in range(steps):
            field = step(field)
        fields.append(field)
    both = expm(until * np.block([[flow, noise], [np.zeros((2, 2)), -flow.T]]))
    there = both[:2, :2]
    for field in fields:
        found, near = moments(field), 1e-6 if order == 4 else 1e-3
        np.testing.assert_allclose(found[0], there @ mean, rtol=0, atol=near)
        np.testing.assert_allclose(found[1], there @ cov @ there.T + both[:2, 2:] @ there.T, rtol=0, atol=near)
    # The mean is at most half of a cell from the centre before a step, and further by what the step makes of it.
    assert abs(np.asarray(comoving.moments(fields[1].values).mean)[0]) < 0.6
