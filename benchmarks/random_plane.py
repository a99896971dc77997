"""Random systems with two states, and an independent solution: sinc collocation on windows that follow the density.

The derivatives are dense matrices along the axes, the time steps those of Runge and Kutta. Before every few steps the window and
the spacings are chosen again from the support and the spectrum of the density. Nothing here is shared with zakai but the model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

import zakai

MOST = 1400  # points along an axis


def system(seed: int) -> tuple[zakai.Model, str]:
    """Return a random model and the kind of its record."""
    rng = np.random.default_rng(seed)

    def u(low: float, high: float) -> str:
        return f"{rng.uniform(low, high):.3f}"

    drifts = [
        [f"{u(-0.5, 1)}*x - {u(0.3, 1)}*x**3 + {u(-1, 1)}*y", f"{u(-1, 1)}*x - {u(0.3, 1)}*y + {u(-0.5, 0.5)}*sin(x)"],
        [f"{u(-1, 1)}*x - {u(0.2, 0.6)}*x**3 + {u(-1, 1)}*y", f"{u(-1, 1)}*y - {u(0.2, 0.6)}*y**3 + {u(-1, 1)}*x"],
        [f"y + {u(-0.3, 0.3)}", f"{u(0.2, 1.5)}*(1 - x**2)*y - x"],
        [f"{u(0.5, 1)}*y", f"{u(-1, 1)}*x - {u(0.2, 1)}*x**3 - {u(0.2, 1)}*y + {u(0, 1)}*cos({u(0.5, 4)}*t)"],
        [f"{u(-2, 2)}*tanh(x + {u(-1, 1)}*y) - {u(0.4, 1)}*x", f"{u(-2, 2)}*tanh({u(-2, 2)}*x) - {u(0.4, 1)}*y"],
        [f"{u(-2, 2)}*sin({u(0.5, 2)}*y) - {u(0.3, 1)}*x", f"{u(-2, 2)}*cos({u(0.5, 2)}*x) - {u(0.3, 1)}*y"],
        [f"{u(-1.5, 1.5)}*atan({u(-2, 2)}*y) - {u(0.3, 1)}*x", f"{u(-1, 1)}*x/(1 + x**2) - {u(0.3, 1)}*y + {u(-1, 1)}"],
        [f"{u(0.5, 1)} - {u(0.5, 1)}*exp(y)", f"{u(0.5, 1)}*exp(x) - {u(0.5, 1)}"],
        [f"{u(0.5, 1.2)}*y", f"-{u(0.5, 2)}*sin(x) - {u(0.1, 0.6)}*y"],
    ]
    number = int(rng.integers(9))
    drift, sizes = drifts[number], (0.7, 0.7, 0.7, 0.7, 0.9, 0.9, 0.9, 0.25, 0.6)[number]
    exponential, angle = number == 7, number == 8
    kind = str(rng.choice(["samples", "increments"]))
    sensors = ["x", "y", "x + y/2", "x*y", "x**2 + y", "tanh(x + y)", f"atan({u(0.5, 3)}*y)", "x - x**3/5", "sin(x) + y"]
    sensors.append("sqrt(1 + x**2 + y**2)")
    if exponential:
        sensors = ["exp(x)", "exp(y)", "x", "exp(x) + exp(y)"]
    if angle:
        sensors = ["cos(x)", "sin(x)", "y", "sin(x) + y/2", "cos(x)*y"]
    m = int(rng.integers(1, 3))
    chosen = [str(h) for h in rng.choice(sensors, m, replace=False)]
    sharp = kind == "samples" and not angle and rng.uniform() < 0.35
    noises = 10 ** (rng.uniform(-3, -1, m) if sharp else rng.uniform(-1.3, 0.3, m))
    first, second, mixed = rng.uniform(0.25, 1.0, 2) * sizes, rng.uniform(-0.5, 0.5) * (rng.uniform() < 0.3), rng.uniform()
    diffusion = [[f"{first[0]:.3f}", "0"], [f"{second:.3f}", f"{first[1]:.3f}"]]
    if mixed < 0.25:
        diffusion = [["0"], [f"{first[1]:.3f}"]]
    elif mixed < 0.35:
        diffusion[0][0] += f"*(1 + {u(0.1, 0.5)}*sin(y))"
    deviations, correlation = rng.uniform(0.2, 0.7, 2) * sizes, rng.uniform(-0.8, 0.8) * (rng.uniform() < 0.5)
    cov = np.outer(deviations, deviations) * (np.eye(2) + correlation * np.array([[0, 1], [1, 0]]))
    prior = {"kind": "gaussian", "mean": rng.uniform(-0.5, 0.5, 2).tolist(), "cov": cov.tolist()}
    model = zakai.Model(
        state=["x", "y"], drift=drift, diffusion=diffusion, observation=chosen, observation_kind=kind,
        observation_noise=[[f"{noises[i]:.5f}" if i == j else "0" for j in range(m)] for i in range(m)],
        periodic=["x"] if angle else [], prior=prior,
    )  # fmt: skip
    return model, kind


def record_of(model: zakai.Model, seed: int) -> zakai.Record:
    """Return a record at 12 irregular times with missing coordinates, one long gap and, now and then, an outlier."""
    rng = np.random.default_rng(1000 + seed)
    lengths = np.exp(rng.normal(np.log(0.15), 1.0, 12)).clip(0.005, 1.0)
    lengths[rng.integers(3, 12)] = rng.uniform(1.0, 3.0)
    _, record = zakai.simulate(model, np.cumsum(lengths), seed=seed)
    values = record.values.copy()
    if rng.uniform() < 0.4:
        k, i = rng.integers(12), rng.integers(values.shape[1])
        noise = float(model.observation_noise[i, i]) * (lengths[k] if record.kind == "increments" else 1.0)
        values[k, i] += rng.choice([-1, 1]) * rng.uniform(2, 6) * np.sqrt(noise)
    values[rng.uniform(size=values.shape) < 0.12] = np.nan
    return zakai.Record(record.times, values, record.kind)


class Axis(NamedTuple):
    """Points of a uniform grid on the line or, `closed`, around the circle."""

    points: np.ndarray
    closed: bool

    @property
    def spacing(self) -> float:
        return float(self.points[1] - self.points[0])

    def cardinal(self, x: np.ndarray) -> np.ndarray:
        """Return the cardinal functions of the points at others (len(x), size)."""
        z = (x[:, None] - self.points) / self.spacing
        if not self.closed:
            return np.asarray(np.sinc(z) * (np.abs(x - self.points.mean())[:, None] < 0.5 * self.spacing * len(self.points)))
        k = np.arange(1, len(self.points) // 2)  # an even number of points
        waves = 2.0 * np.cos(2 * np.pi / len(self.points) * z[..., None] * k).sum(axis=-1)
        return np.asarray((1.0 + waves + np.cos(np.pi * z)) / len(self.points))

    def derivative(self) -> np.ndarray:
        """Return the matrix of the derivative."""
        apart = np.arange(len(self.points))[:, None] - np.arange(len(self.points))
        sign, safe = np.where(apart % 2 == 0, 1.0, -1.0), np.where(apart == 0, 1, apart)
        slope = 0.5 * sign / np.tan(0.5 * safe * self.spacing) if self.closed else sign / (safe * self.spacing)
        return np.where(apart == 0, 0.0, slope)


def axis(low: float, high: float, spacing: float, closed: bool) -> Axis:
    """Return the axis from low to high, of at most `MOST` points."""
    if closed:
        size = 2 * int(np.clip(np.pi / spacing + 1, 12, MOST / 2))
        return Axis(-np.pi + 2 * np.pi / size * np.arange(size), True)
    return Axis(np.linspace(low, high, int(np.clip((high - low) / spacing + 2, 16, MOST))), False)


class Density(NamedTuple):
    """Values (N, M) on two axes."""

    values: np.ndarray
    axes: tuple[Axis, ...]

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        return self.axes[0].points[:, None], self.axes[1].points[None, :]

    @property
    def cell(self) -> float:
        return self.axes[0].spacing * self.axes[1].spacing

    def on(self, axes: tuple[Axis, ...]) -> Density:
        """Return the interpolant on other axes."""
        one, two = (old.cardinal(new.points) for old, new in zip(self.axes, axes, strict=True))
        return Density(one @ self.values @ two.T, axes)

    def extent(self, level: float) -> np.ndarray:
        """Return the lowest and highest point and the spacing (2, 3) that a share `level` of the maximum needs."""
        out = []
        for d, own in enumerate(self.axes):
            profile = np.abs(self.values).max(axis=1 - d)
            used = np.flatnonzero(profile > level * profile.max())
            spectrum = np.abs(np.fft.rfft(self.values, axis=d)).max(axis=1 - d)
            highest = np.flatnonzero(spectrum > level * spectrum.max())[-1] + 1.0
            share = 1.25 if highest >= 0.98 * (len(spectrum) - 1) else max(highest / len(spectrum), 0.3)
            out.append((own.points[used[0]], own.points[used[-1]], own.spacing / share))
        return np.array(out)

    def moments(self, closed: bool) -> list[float]:
        """Return the means and the variances (4,); the mean of an angle is its direction."""
        out = []
        for d, own in enumerate(self.axes):
            weights, x = self.values.sum(axis=1 - d) / self.values.sum(), own.points
            mean = float(weights @ x)
            if closed and d == 0:
                mean = float(np.angle(weights @ np.exp(1j * x)))
                x = mean + np.angle(np.exp(1j * (x - mean)))
            out.append((mean, float(weights @ (x - mean) ** 2)))
        return [out[0][0], out[1][0], out[0][1], out[1][1]]


Values = Callable[..., list[np.ndarray]]


def functions(model: zakai.Model, entries: Any) -> Values:
    """Return a function of x, y and t that gives the values of formulas on a mesh."""
    made = sp.lambdify((*model.x, model.t), list(entries), "numpy")
    return lambda x, y, t: [value + 0.0 * (x + y) for value in made(x, y, t)]


class Equation(NamedTuple):
    """The Kolmogorov equation of a model: f, G in its three entries, and the potential over an interval, if any."""

    drift: Values
    noise: Values
    potential: Callable[[Any, Any], np.ndarray] | None
    varying: bool


def advanced(start: Density, equation: Equation, t0: float, t1: float, level: float) -> Density:
    """Return the density at the end of an interval."""
    found, t, reach = start, t0, np.sqrt(-2 * np.log(level))
    while t < t1:
        extent = found.extent(level)
        low, high, spacing = extent.T
        noise = np.array([np.abs(g).max() for g in np.array(equation.noise(*found.mesh, t))[[0, 2]]])
        width = reach / np.pi * spacing  # smallest standard deviation with such a spectrum
        inside = np.argwhere(np.abs(found.values) > level * found.values.max())
        points = np.stack([own.points[i] for own, i in zip(found.axes, inside.T, strict=True)])
        speed = np.abs(np.array(equation.drift(*points, t))).max(axis=1)
        length = min(t1 - t, *(width**2 / np.maximum(noise, 1e-12)), *(0.3 * (high - low) / np.maximum(speed, 1e-12)))
        length = t1 - t if t1 - t < 1.2 * length else length
        ends = points
        for i in range(4):
            k = np.array(equation.drift(*ends, t + 0.25 * i * length))
            ends = ends + 0.25 * length * np.array(equation.drift(*(ends + 0.125 * length * k), t + 0.25 * (i + 0.5) * length))
        extra = reach * (np.sqrt(width**2 + noise * length) - width)
        low, high = np.minimum(low, ends.min(axis=1)) - extra - spacing, np.maximum(high, ends.max(axis=1)) + extra + spacing
        axes = tuple(axis(low[d], high[d], 0.93 * spacing[d], found.axes[d].closed) for d in range(2))
        found, t = steps(found.on(axes), equation, t, t + length), t + length
    return found


def steps(start: Density, equation: Equation, t0: float, t1: float) -> Density:
    """Return the density after Runge-Kutta steps on its grid, as long as they are stable."""
    (one, two), mesh = (own.derivative() for own in start.axes), start.mesh
    limits = [np.pi / own.spacing for own in start.axes]

    def coefficients(t: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
        return equation.drift(*mesh, t), equation.noise(*mesh, t)

    f, g = kept = coefficients(0.5 * (t0 + t1))
    singular, diagonal = not g[0].any(), not g[1].any()
    V = equation.potential(*mesh) if equation.potential else None
    rate = sum(np.abs(v).max() * k for v, k in zip(f, limits, strict=True))
    rate += 0.5 * sum(np.abs(g[2 * d]).max() * k**2 for d, k in enumerate(limits)) + np.abs(g[1]).max() * limits[0] * limits[1]
    rate += 0.0 if V is None else np.abs(V).max()

    def slope(u: np.ndarray, t: float) -> np.ndarray:
        f, g = coefficients(t) if equation.varying else kept
        first, second = f[0] * u, f[1] * u - 0.5 * (g[2] * u) @ two.T
        if not singular:
            first = first - 0.5 * one @ (g[0] * u)
        if not diagonal:
            first, second = first - 0.5 * (g[1] * u) @ two.T, second - 0.5 * one @ (g[1] * u)
        out = -(one @ first) - second @ two.T
        return out if V is None else out + V * u

    u, count = start.values, int(np.ceil((t1 - t0) * rate / 2.2)) + 1
    h = (t1 - t0) / count
    for i in range(count):
        t = t0 + i * h
        k1 = slope(u, t)
        k2 = slope(u + 0.5 * h * k1, t + 0.5 * h)
        k3 = slope(u + 0.5 * h * k2, t + 0.5 * h)
        u = u + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(u + h * k3, t + h))
    return start._replace(values=u)


def log_likelihood(h: Values, S: np.ndarray, values: np.ndarray, seen: np.ndarray, t: float) -> Callable[[Any, Any], Any]:
    """Return the function -sum (values - h)^2 / (2 S) of x and y, over the coordinates that are seen."""

    def logs(x: Any, y: Any) -> Any:
        found = h(x, y, t)
        return -0.5 * sum((values[i] - found[i]) ** 2 / variance for i, variance in zip(seen, S, strict=True))

    return logs


def reference(model: zakai.Model, record: zakai.Record, level: float) -> np.ndarray:
    """Return means, variances and log-likelihood increment after each observation (K, 5), to a share `level` of densities."""
    closed, G = bool(model.periodic), model.covariance
    drift, noise, h = (functions(model, e) for e in (model.drift, (G[0, 0], G[0, 1], G[1, 1]), model.observation))
    slopes = functions(model, model.observation.jacobian(list(model.x)))
    S = np.diagonal(np.array(model.observation_noise, float))
    mean, cov = np.array(model.prior.mean, float), np.array(model.prior.cov, float)
    reach = np.sqrt(-2 * np.log(level))
    half, fine = reach * np.sqrt(np.diagonal(cov)), np.pi / reach / np.sqrt(np.diagonal(np.linalg.inv(cov)))
    axes = tuple(axis(mean[d] - half[d], mean[d] + half[d], fine[d], closed and d == 0) for d in range(2))
    x, y = axes[0].points[:, None] - mean[0], axes[1].points[None] - mean[1]
    inverse, values = np.linalg.inv(cov), 0.0
    for turn in np.arange(-2, 3) * 2 * np.pi if closed else (0.0,):
        z = x + turn
        values = values + np.exp(-0.5 * (inverse[0, 0] * z**2 + 2 * inverse[0, 1] * z * y + inverse[1, 1] * y**2))
    u, out, start = Density(np.asarray(values), axes), [], 0.0
    u = u._replace(values=u.values / (u.values.sum() * u.cell))
    for stop, observed in zip(record.times, record.values, strict=True):
        seen, tau, top = np.flatnonzero(~np.isnan(observed)), stop - start, 0.0
        inside, logs = len(seen) > 0 and record.kind == "increments", log_likelihood(h, S[seen], observed, seen, stop)
        potential = None
        if inside:
            rates = log_likelihood(h, S[seen], observed / tau, seen, stop)
            top = float(rates(*u.mesh).max())  # any constant near the largest value
            potential = lambda x, y, rates=rates, top=top: rates(x, y) - top  # noqa: E731
        u = advanced(u, Equation(drift, noise, potential, model.drift.has(model.t)), start, float(stop), level)
        gained = 0.0
        if inside:
            gained = top * tau + sum(0.5 * observed[i] ** 2 / (S[i] * tau) for i in seen)
        elif len(seen):
            low, high, spacing = u.extent(level).T
            near = u.values > level * u.values.max()
            steep = [np.array([np.abs(v[near]).max() for v in slopes(*u.mesh, stop)]).reshape(-1, 2)[seen, d] for d in range(2)]
            curved = np.array([np.sqrt(np.sum(s**2 / S[seen])) for s in steep])
            fine = 1 / np.sqrt(1 / spacing**2 + (curved * reach / np.pi) ** 2)
            u = u.on(tuple(axis(low[d], high[d], fine[d], u.axes[d].closed) for d in range(2)))
            found = logs(*u.mesh)
            top = float(found.max(where=u.values > level * u.values.max(), initial=-np.inf))
            u = u._replace(values=u.values * np.exp(np.minimum(found - top, 50.0)))
            gained = top - 0.5 * float(np.sum(np.log(2 * np.pi * S[seen])))
        mass = u.values.sum() * u.cell
        u, start = u._replace(values=u.values / mass), float(stop)
        out.append((*u.moments(closed), gained + np.log(mass)))
    return np.array(out)
