"""A model as the particle filter takes it: programs of its formulas, and its coefficients as functions of time.

For increments the law of x given the path y is that of Girsanov's theorem, with y linear between observations and, for correlated
noise E dv dw' = C dt, with a = g C, K = S^-1,

    dx = (f + a K (dy/dt - h) - sum K_ij (a_j.grad) a_i / 2) dt + g dv~,      E dv~ dv~' = (Q - C K C') dt
    log weight = int h'K dy/dt - h'K h / 2 - tr(K a'h_x') / 2 dt

Where g depends on the state the drift is that of Stratonovich, f - sum (Q - C K C')_ab (g_b.grad) g_a / 2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.densities import GridDensity
from zakai.methods.particles.law import Law, Numbers
from zakai.methods.particles.programs import Array, Expressions
from zakai.methods.system.outside_tables import OutsideTables
from zakai.methods.system.prior_moments import prior_moments
from zakai.models.domain import Interval
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, GaussianPrior, MixturePrior
from zakai.numerics.particles.motion import ADDITIVE, COMMUTING, ORDERED
from zakai.numerics.particles.noise import write_roots
from zakai.numerics.prior_grid import prior_grid

_MOST_ENTRIES = 400  # of the Jacobian of a drift that is checked for being affine


class Noise(NamedTuple):
    """The fields g (n, r) of the noise with its covariance Q (r, r), the coordinates x (n,), and those after the states."""

    fields: sp.Matrix
    Q: sp.Matrix
    x: tuple[sp.Symbol, ...]
    more: tuple[sp.Symbol, ...]


class System:
    """The formulas of a model as programs."""

    def __init__(self, model: Model):
        n, m = model.n, model.m
        self.model, self.n, self.m, self.inputs = model, n, m, len(model.u)
        self.sampled = model.observation_kind == "samples"
        self.numbers = Numbers.of(m, not model.observation_noise.is_diagonal() or not model.cross_noise.is_zero_matrix)
        self.observe = Expressions(list(model.observation) if model.log_density is None else [sp.S.Zero], model)
        self.noise = numpy_function(model.observation_noise, model, (m, m))
        cross, r = model.cross_noise, model.diffusion.cols
        self.cross = None if cross.is_zero_matrix else numpy_function(cross, model, (r, m))
        self.law: Law | None = None
        self.factor: Expressions | None = None
        self.update: Expressions | None = None  # of the state by an observation
        self.linear = 0  # the number of states of which particles carry the mean and the covariance
        self.outside = OutsideTables(model)
        self._set_formulas()
        self.box = (np.full(n, -np.inf), np.full(n, np.inf))
        for name, interval in model.domain.items():
            place = model.state.index(name)
            self.box[0][place], self.box[1][place] = interval.lower, interval.upper
        self.angles = np.array([name in model.periodic for name in model.state])
        # The coordinates by which each one contracts, and the row of the variance that particles carry: see `StepErrors`.
        self.owners = np.column_stack([np.arange(n), np.full((n, 2), -1)])
        self.timed = bool(model.inputs) or any(
            part.has(model.t) for part in (model.diffusion, model.process_noise, model.observation_noise, model.cross_noise)
        )
        self.driven = bool(model.drift.free_symbols & {model.t, *model.u})  # whether f depends on time
        # Whether kicks between exact flows are exact: the drift is constant between the times of inputs, and so is the noise.
        drift = set[sp.Symbol]().union(*(f.free_symbols for f in self.formulas))
        noise = model.diffusion.free_symbols | model.process_noise.free_symbols
        moving = {model.t, *model.u} if model.input_hold == "linear" else {model.t}
        self.exact = self.sampled and self.affine and not drift & moving and not noise & {model.t, *model.u}

    def _set_formulas(self) -> None:
        """Set the programs of the motion and of the observation."""
        model, given = self.model, list[sp.Symbol]()
        drift, potential = list(model.drift), list[sp.Expr]()
        if self.sampled:
            self.law = Law(model)
        else:
            given = [*self.numbers.z, *(self.numbers.P[pair] for pair in self.numbers.pairs)]
            *drift, weight = self._with_increments(drift)
            potential.append(weight)
            self.factor = Expressions([self._factor()], model, given)
        noise = Noise(sp.Matrix(model.diffusion), sp.Matrix(model.process_noise), model.x, ())
        self._set_motion(noise, drift, potential, given)

    def _set_motion(self, noise: Noise, drift: list[sp.Expr], potential: list[sp.Expr], given: list[sp.Symbol]) -> None:
        """Set the programs of drift and noise.

        Args:
            noise: that of all coordinates.
            drift: of all coordinates, of the Ito kind.
            potential: the logarithm of the weight per unit time, if there is one.
            given: the symbols of the given numbers after the inputs.
        """
        model, (g, Q, x, more) = self.model, noise
        n, r = g.shape
        self.kind, self.r = ADDITIVE, r
        fields: list[sp.Expr] = [sp.S.Zero]
        coefficients = tuple(sp.Dummy(f"c{a}", real=True) for a in range(r))
        self.root_pairs: list[tuple[int, int]] = []
        if g.free_symbols & set(x):
            along = [[[_along(g[i, a], g[:, b], x) for b in range(r)] for a in range(r)] for i in range(n)]
            diagonal = Q.is_diagonal() and model.cross_noise.is_zero_matrix
            commute = all(
                sp.expand(along[i][a][b] - along[i][b][a]) == 0 for i in range(n) for a in range(r) for b in range(a)
            )
            self.kind = COMMUTING if commute else ORDERED
            self.root_pairs = [(a, b) for a in range(r) for b in range(a + 1) if a == b or not diagonal]
            Q_given = {pair: sp.Dummy(f"Q{pair}", real=True) for pair in self.root_pairs}
            for i in range(n):
                terms = [q * (along[i][a][b] + along[i][b][a]) / (4 if a == b else 2) for (a, b), q in Q_given.items()]
                drift[i] -= sum(terms, sp.S.Zero)
            given = [*given, *Q_given.values()]
            fields = [sum((g[i, a] * coefficients[a] for a in range(r)), sp.S.Zero) for i in range(n)]
        else:
            self.diffusion = numpy_function(g, model, (n, r))
        self.formulas, self.given = (*drift, *potential), tuple(given)
        linear, whole = _linear_part(drift, x, {*x, model.t, *model.u, *given})
        self.affine = whole and self.kind == ADDITIVE
        self.noisy = np.array([any(entry != 0 for entry in g[i, :]) for i in range(n)])
        for _ in range(n):  # those that noise reaches by the drift
            reached = {symbol for symbol, noisy in zip(x, self.noisy, strict=True) if noisy}
            self.noisy |= np.array([bool(f.free_symbols & reached) for f in drift])
        self.linear_part = None if linear.is_zero_matrix else numpy_function(linear, model, linear.shape)
        self.drift = Expressions([*drift, *potential], model, given, more)
        self.fields = Expressions(fields, model, given, (*more, *coefficients))
        self.process_noise = numpy_function(Q, model, (r, r))

    def _with_increments(self, drift: list[sp.Expr]) -> list[sp.Expr]:
        """Return the drift given the increments, and the logarithm of the weight per unit time."""
        model, r, P = self.model, self.numbers.z, self.numbers.P
        h, x, m = list(model.observation), model.x, self.m
        potential = self._factor()
        if not model.cross_noise.is_zero_matrix:
            a = sp.Matrix(model.diffusion * model.cross_noise)
            innovation = [r[k] - sum((P[k, b] * h[b] for b in range(m)), sp.S.Zero) for k in range(m)]
            for i in range(self.n):
                drift[i] += sum((a[i, k] * innovation[k] for k in range(m)), sp.S.Zero)
                drift[i] -= sum((P[b, c] * _along(a[i, b], a[:, c], x) for b in range(m) for c in range(m)), sp.S.Zero) / 2
            potential -= sum((P[j, k] * _along(h[j], a[:, k], x) for j in range(m) for k in range(m)), sp.S.Zero) / 2
        return [*drift, potential]

    def _factor(self) -> sp.Expr:
        """Return h'r - h'P h / 2."""
        h, r, P = list(self.model.observation), self.numbers.z, self.numbers.P
        linear = sum((one * factor for one, factor in zip(h, r, strict=True)), sp.S.Zero)
        square = [(1 if i == j else 2) * P[i, j] * h[i] * h[j] for i, j in self.numbers.pairs]
        return linear - sum(square, sp.S.Zero) / 2

    def precision(self, t: float, seen: Array, theta: Array, u: Array | None) -> Array:
        """Return the inverse (m, m) of the noise of the observed coordinates per unit time, zero elsewhere."""
        P, which = np.zeros((self.m, self.m)), np.flatnonzero(seen)
        if len(which):
            S = self.noise(np.zeros(self.model.n), t, theta, u)
            P[np.ix_(which, which)] = np.linalg.inv(S[np.ix_(which, which)])
        return P

    def own_noise(self, t: float, P: Array, theta: Array, u: Array | None) -> Array:
        """Return Q - C K C' (r, r): the noise of the state that is independent of that of the observations."""
        Q = np.asarray(self.process_noise(np.zeros(self.model.n), t, theta, u))
        if self.cross is None:
            return Q
        C = self.cross(np.zeros(self.model.n), t, theta, u)
        return Q - C @ P @ C.T


    @property
    def width(self) -> int:
        """The number of given numbers of an event."""
        return max(self.drift.width, 0 if self.update is None else self.update.width)

    def widened(self, mean: Array, cov: Array) -> Array:
        """Return the covariance (n, n) of the states from that of the particles."""
        return cov

    def scales(self, cov: Array) -> Array:
        """Return standard deviations (n,) of the coordinates from the covariance of the states."""
        return np.sqrt(np.maximum(np.diag(cov), 0.0))

    def gaussian_prior(self, prior: Any) -> tuple[Array, Array] | None:
        """Return the mean (n,) and a root (n, d) of the covariance of a Gaussian prior, None for another one."""
        return (np.array(prior.mean, float), root(prior.cov)) if isinstance(prior, GaussianPrior) else None

    def drawn(self, prior: Any, theta: Array, count: int, rng: np.random.Generator) -> Array:
        """Return states (n, count) drawn from a prior that is not Gaussian.

        Raises:
            InputError: a density in more than four coordinates.
        """
        model = self.model
        if isinstance(prior, MixturePrior):
            return np.ascontiguousarray(prior.sample(rng, count).T)
        assert isinstance(prior, DensityPrior)
        if model.n > 4:
            prior_moments(model, prior, theta)  # which says what to do
        formula, ends = numpy_function(prior.log_density, model), [model.domain.get(name, Interval()) for name in model.state]

        def from_line(y: Array) -> tuple[Array, Array]:
            """States (J, n) inside of the domain for numbers of the line, where no end cuts a density, and log dx/dy (J,)."""
            x, slopes = zip(*(end.from_line(part) for end, part in zip(ends, y.T, strict=True)), strict=True)
            return np.column_stack(x), np.sum(slopes, axis=0)

        def log_density(y: Array) -> Array:
            x, slope = from_line(y)
            return np.asarray(formula(x, model.start, theta) + slope)

        periodic, source = [name in model.periodic for name in model.state], f"{model.source}: prior: log_density"
        grid = prior_grid(log_density, model.n, periodic, tolerance=1e-9, source=source)
        density = GridDensity(grid.log_values, grid.centre, grid.basis, model.state, (False,) * model.n)
        return np.ascontiguousarray(from_line(density.sample(rng, count))[0].T)


def _along(function: sp.Expr, field: sp.Matrix, x: tuple[sp.Symbol, ...]) -> sp.Expr:
    """Return the derivative of a function along a field, apart from jumps."""
    total = sp.S.Zero
    for place, symbol in enumerate(x):
        if field[place] != 0 and function.has(symbol):
            total += sp.diff(function, symbol).replace(sp.DiracDelta, lambda *_: sp.S.Zero) * field[place]
    return total


def _linear_part(drift: list[sp.Expr], x: tuple[sp.Symbol, ...], free: set[sp.Symbol]) -> tuple[sp.Matrix, bool]:
    """Return the constant matrix (n, n) of an affine drift and true, else the constant rates of its coordinates and false.

    Of a drift that is not affine other constant entries of df/dx may be those of motions that others keep stable.
    """
    n = len(x)
    if n**2 > _MOST_ENTRIES:
        return sp.zeros(n, n), False
    slopes = sp.Matrix(n, n, lambda i, j: sp.diff(drift[i], x[j]) if drift[i].has(x[j]) else sp.S.Zero)
    if not slopes.free_symbols & free:
        return slopes, True
    return sp.diag(*(sp.S.Zero if slopes[i, i].free_symbols & free else slopes[i, i] for i in range(n))), False


def system_of(model: Model) -> System:
    """Return the programs of a model, made once."""
    return kept(model, System, lambda: System(model))


def root(Q: Array) -> Array:
    """Return columns R (n, d) with R R' = Q, without null directions."""
    return np.ascontiguousarray(roots(Q[None])[0])


def roots(Q: Array) -> Array:
    """Return columns R (J, n, d) with R R' = Q for matrices (J, n, n); the last ones are zero where Q has null directions.

    A coordinate with little noise keeps it.
    """
    found = np.empty(Q.shape)
    width = write_roots(np.ascontiguousarray(Q), found)
    return np.ascontiguousarray(found[:, :, :width])
