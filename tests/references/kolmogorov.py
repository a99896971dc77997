"""A plain, slow, independent solver of the Kolmogorov equation between two observations.

    u_t = 1/2 G(t) : Hess u - f(x, t) . grad u - (div f + 1/2 h' S^-1 h) u

Space: Fourier collocation on a periodic box that is wide enough for u to vanish at its edge. Time: DOP853.
The equation is solved as it stands: no gauge, no kernel, nothing that the package relies on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp

Field = Callable[[np.ndarray, float], np.ndarray]


class Box:
    """The periodic box of this half width about `centre`, with the same number of points on each axis."""

    def __init__(
        self, half_width: float | Sequence[float], points: int, centre: Sequence[float] = (0.0,)
    ) -> None:
        self.centre = np.atleast_1d(np.asarray(centre, float))
        self.n = len(self.centre)
        half_widths = np.broadcast_to(np.asarray(half_width, float), (self.n,))
        self.points = points
        self.axes = [
            c + w * (2.0 * np.arange(points) / points - 1.0)
            for c, w in zip(self.centre, half_widths, strict=True)
        ]
        self.x = np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1)
        self.cell = float(np.prod(2.0 * half_widths / points))
        frequencies = [2.0j * np.pi * np.fft.fftfreq(points, 2.0 * w / points) for w in half_widths]
        frequencies[-1] = 2.0j * np.pi * np.fft.rfftfreq(points, 2.0 * half_widths[-1] / points)
        self.gradient_symbols = np.meshgrid(*frequencies, indexing="ij")

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.points,) * self.n


def propagate(
    box: Box,
    u: np.ndarray,
    start: float,
    stop: float,
    drift: Field,
    divergence: Field,
    covariance: Callable[[float], np.ndarray],
    potential: Field,
    tolerance: float = 1e-13,
) -> np.ndarray:
    """Carry u over [start, stop]; `potential` is h' S^-1 h, and x has shape (*grid, n) in every callable."""
    n, size = box.n, np.max(np.abs(u))
    k = box.gradient_symbols

    def rate(t: float, values: np.ndarray) -> np.ndarray:
        values = values.reshape(box.shape)
        spectrum = np.fft.rfftn(values)
        G, f = covariance(t), drift(box.x, t)
        second = sum(G[i, j] * k[i] * k[j] for i in range(n) for j in range(n))
        result = 0.5 * np.fft.irfftn(second * spectrum, box.shape, range(n))
        for i in range(n):
            result -= f[..., i] * np.fft.irfftn(k[i] * spectrum, box.shape, range(n))
        result -= (divergence(box.x, t) + 0.5 * potential(box.x, t)) * values
        return result.ravel()

    solution = solve_ivp(
        rate,
        (start, stop),
        (u / size).ravel(),
        method="DOP853",
        rtol=tolerance,
        atol=tolerance,
        t_eval=[stop],
    )
    if not solution.success:
        raise RuntimeError(solution.message)
    return size * solution.y[:, -1].reshape(box.shape)


def propagate_system(
    box: Box, u: np.ndarray, start: float, stop: float, system, tolerance: float = 1e-13
) -> np.ndarray:
    """`propagate` with the coefficients of a `systems.System`."""
    return propagate(box, u, start, stop, system.f, system.div_f, system.G, system.h_S_h, tolerance)


def filter_system(box: Box, system, tolerance: float = 1e-13) -> list[tuple[np.ndarray, np.ndarray]]:
    """The density at the end of each of the system's intervals, before and after its observation is used."""
    u, start, densities = system.initial(box.x), system.start, []
    for stop, increment in zip(system.times, system.increments, strict=True):
        before = propagate_system(box, u, start, stop, system, tolerance)
        u = before * system.jump(box.x, stop, increment)
        densities.append((before, u))
        start = stop
    return densities
