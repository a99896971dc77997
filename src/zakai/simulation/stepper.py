"""Steps of a path whose noise depends on the state, or whose state lives in a domain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.errors import InputError
from zakai.models.numeric import explain_nonfinite, program_of

if TYPE_CHECKING:
    from zakai.models.model import Model

MOST_HALVINGS = 40  # of a step that leaves the domain
Array = NDArray[Any]
Drift = Callable[[Sequence[float], float, Any], Sequence[float]]


def outside_domain(model: Model, x: Any) -> str | None:
    """Return the name of the first state that is outside of its domain, or None."""
    for name, interval in model.domain.items():
        if not interval.lower <= x[model.state.index(name)] <= interval.upper:
            return name
    return None


def milstein_terms(model: Model) -> sympy.Matrix:
    """Return M (n, r) = sum_k g_kj d_k g_ij / 2, or zeros where the noises do not commute in an evident way.

    x' = x + f h + g dv + sum_j M_j (dv_j^2 - Q_jj h)
    """
    g, zero = model.diffusion, sympy.zeros(*model.diffusion.shape)

    def along(j: int, column: int) -> list[sympy.Expr]:
        return [sum(g[k, j] * sympy.diff(g[i, column], model.x[k]) for k in range(model.n)) for i in range(model.n)]

    if not model.process_noise.is_diagonal() or model.n * g.cols > 64:
        return zero
    if any(entry != 0 for j in range(g.cols) for other in range(g.cols) if j != other for entry in along(j, other)):
        return zero
    terms = sympy.Matrix.hstack(*[sympy.Matrix(along(j, j)) / 2 for j in range(g.cols)])
    return zero if terms.has(sympy.DiracDelta, sympy.Derivative) else terms


def mean_drift(drift: Drift, x: list[float], t: float, u: Any, step: float) -> list[float]:
    """Return the mean of f (n,) along x' = f(x, t) over a step, by the method of Runge and Kutta."""
    a = drift(x, t, u)
    b = drift([xi + 0.5 * step * ai for xi, ai in zip(x, a)], t + 0.5 * step, u)
    c = drift([xi + 0.5 * step * bi for xi, bi in zip(x, b)], t + 0.5 * step, u)
    d = drift([xi + step * ci for xi, ci in zip(x, c)], t + step, u)
    return [(ai + 2.0 * bi + 2.0 * ci + di) / 6.0 for ai, bi, ci, di in zip(a, b, c, d)]


class Stepper:
    """The path of one model with fixed parameters, with plain floats, which are faster than arrays of a few numbers."""

    def __init__(self, model: Model, theta: Array, rng: np.random.Generator, of_euler: bool):
        self.model, self._rng, self._of_euler = model, rng, of_euler
        self._r = model.diffusion.cols
        self._domain = [(model.state.index(name), interval) for name, interval in model.domain.items()]
        formulas = [*model.drift, *model.diffusion, *milstein_terms(model)]
        self._formulas = program_of(formulas, model, stable=True).scalar(theta.tolist())
        self._drift = program_of(list(model.drift), model, stable=True).scalar(theta.tolist())

    def path(self, state: Array, times: Array, steps: Array, roots: Array, noise: Array, u: Array | None) -> Array:
        """Return the states (N + 1, n) at the ends of all steps.

        Args:
            state: (n,), the first.
            times: (N,), where the steps begin.
            steps: (N,), their lengths.
            roots: (N, r, r), square roots of Q.
            noise: (N, r), standard normal.
            u: (N, number of inputs) or None.

        Raises:
            InputError: the state is not finite, or leaves its domain.
        """
        x = state.tolist()
        fine = [x]
        increments = (roots @ noise[..., None])[..., 0] * np.sqrt(steps)[:, None]
        inputs: list[Any] = [()] * len(times) if u is None else u.tolist()
        for k, (t, step, dv, own) in enumerate(zip(times.tolist(), steps.tolist(), increments.tolist(), inputs)):
            x = self._advance(x, t, step, dv, roots[k], own, 0)
            fine.append(x)
        return np.array(fine)

    def _advance(self, x: list[float], t: float, step: float, dv: list[float], root: Array, u: Any, halvings: int) -> list[float]:
        new, fault = self._step(x, t, step, dv, root, u)
        if fault is None:
            return new
        if halvings == MOST_HALVINGS or (fault == "formula" and halvings > 8):
            self._refuse(x, t, u, fault)
        # The Brownian bridge: the path of the noise is the same, and known at the middle too.
        middle = (np.array(dv) + np.sqrt(step) * (root @ self._rng.standard_normal(self._r))) / 2
        first = self._advance(x, t, step / 2, middle.tolist(), root, u, halvings + 1)
        return self._advance(first, t + step / 2, step / 2, (np.array(dv) - middle).tolist(), root, u, halvings + 1)

    def _step(
        self, x: list[float], t: float, step: float, dv: list[float], root: Array, u: Any
    ) -> tuple[list[float], str | None]:
        n, r = len(x), self._r
        try:
            values = self._formulas(x, t, u)
            drift, new = self._mean_drift(values[:n], x, t, step, u), []
            for i in range(n):
                g, m = values[n + i * r : n + (i + 1) * r], values[n + (n + i) * r : n + (n + i + 1) * r]
                change = drift[i] * step
                for j in range(r):
                    change += g[j] * dv[j]
                    if m[j]:
                        change += m[j] * (dv[j] * dv[j] - float(root[j] @ root[j]) * step)
                new.append(x[i] + change)
        except (ValueError, ArithmeticError):  # no such number, or too large a one
            return x, "formula"
        for i, interval in self._domain:
            if interval.reflecting:
                new[i] = float(interval.reflected(new[i]))
            elif not interval.lower <= new[i] <= interval.upper:
                return x, "domain"
        return (new, None) if all(abs(value) < 1e300 for value in new) else (x, "formula")

    def _mean_drift(self, first: list[float], x: list[float], t: float, step: float, u: Any) -> list[float]:
        """Return the mean drift over a step; `first`, that at its start, where it leads to states at which f has no value."""
        if self._of_euler:
            return first
        try:
            mean = mean_drift(self._drift, x, t, u, step)
        except (ValueError, ArithmeticError):
            return first
        return mean if all(abs(value) < 1e300 for value in mean) else first

    def _refuse(self, x: list[float], t: float, u: Any, fault: str) -> None:
        model, point = self.model, np.array(x)
        if fault == "formula":
            for key in ("drift", "diffusion"):
                reason = explain_nonfinite(model, key, getattr(model, key), point, t, np.array(u) if len(u) else None)
                if reason:
                    raise InputError(f"{model.source}: {reason}")
            raise InputError(
                f"{model.source}: drift: the state grows beyond double precision after t = {t:.6g}; try more substeps"
            )
        where = ", ".join(f"{name} = {x[model.state.index(name)]:.6g} {interval}" for name, interval in model.domain.items())
        raise InputError(
            f"{model.source}: domain: the path leaves it at t = {t:.6g} ({where}); a natural end is one that the process does "
            'not reach: check the drift and the diffusion there, or give boundary = "reflecting"'
        )
