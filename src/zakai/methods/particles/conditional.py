"""Particles that carry a Kalman filter: the equations of a system whose states v are linear given the others, u.

    du = (a + A v) dt + noise,    dv = (b + B v) dt + noise,    h = c + C v,    a to C functions of u, t and inputs

Given a path of u and the observations v is Gaussian with mean m and covariance P (Liptser and Shiryaev 1977, theorem 12.7), and
(u, m, P) is a diffusion of its own, with G_uu = R R' and W of independent Brownian motions,

    du = (a + A m) dt + R dW,    dm = (b + B m) dt + K dW,    K = (P A' + G_vu) R'^-1
    dP/dt = B P + P B' + G_vv - K K'

Its path is a function of the noise of u alone, so that substeps, guides, powers and moves of the past act on it as on any system.
A sample multiplies the weight by N(z; c + C m, S + C P C') and updates m and P; increments act between observations by

    log weight = int r'h - h'P_o h / 2 - tr(C'P_o C P) / 2 dt,   dm += P C'(r - P_o h) dt,   dP -= P C'P_o C P dt,   h = c + C m

with P_o = S^-1 and r = P_o dy/dt.  Coordinates of a sample act one after the other.

References:
    Chen and Liu 2000, Mixture Kalman filters; Doucet, Godsill and Andrieu 2000 (Rao-Blackwellisation).
    Schön, Gustafsson and Nordlund 2005, Marginalized particle filters for mixed linear/nonlinear state-space models.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.methods.particles.law import Law, Numbers
from zakai.methods.particles.programs import Array, Expressions
from zakai.methods.particles.split import is_coupled, noisy_others, reads, split_of
from zakai.methods.particles.system import Noise, System, root, system_of
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import GaussianPrior, MixturePrior


class Block(NamedTuple):
    """The linear states of a model: their numbers, and symbols for the covariance P (k, k) with the entries (i, j), i >= j."""

    linear: tuple[int, ...]
    P: sp.Matrix
    pairs: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, linear: tuple[int, ...]) -> Block:
        """Return the block with new symbols."""
        k = len(linear)
        P = sp.zeros(k, k)
        pairs = tuple((i, j) for i in range(k) for j in range(i + 1))
        for i, j in pairs:
            P[i, j] = P[j, i] = sp.Dummy(f"P{i}_{j}", real=True)
        return cls(linear, P, pairs)

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """The entries of the covariance in the order of the coordinates."""
        return tuple(self.P[pair] for pair in self.pairs)

    def v(self, model: Model) -> list[sp.Symbol]:
        """Return the linear states."""
        return [model.x[i] for i in self.linear]


class Updated(NamedTuple):
    """What observations with independent noise make of the linear states: log weights, the changed mean, and the covariance.

    `defined` are the formulas of the symbols that stand in these.
    """

    terms: dict[int, sp.Expr]
    mean: list[sp.Expr]
    P: sp.Matrix
    defined: dict[sp.Symbol, sp.Expr]


def updated(model: Model, block: Block, numbers: Numbers, rows: list[int]) -> Updated:
    """Return Kalman's update by the observations `rows`, one after the other, each with its precision p.

    With q = C_j P C_j' the log weight is log N(z_j; h_j, 1 / p) at the mean and q p^2 (z_j - h_j)^2 / (2 s) - log(s) / 2,
    s = 1 + p q, beside it.
    """
    samples = model.observation_kind == "samples"
    v, defined = block.v(model), dict[sp.Symbol, sp.Expr]()

    def symbol(formula: sp.Expr) -> sp.Expr:
        if formula.is_Atom:
            return formula
        name = sp.Dummy(real=True)
        defined[name] = formula
        return name

    moved, P, terms = [sp.S.Zero] * len(v), sp.Matrix(block.P), dict[int, sp.Expr]()
    fixed = not samples or not model.observation_noise.free_symbols & set(model.x)
    for j in rows:
        h = model.observation[j]
        c = [sp.diff(h, one) for one in v]
        at_mean = symbol(h + sum((one * change for one, change in zip(c, moved, strict=True)), sp.S.Zero))
        p = symbol(numbers.P[j, j] if fixed else numbers.e[j] / model.observation_noise[j, j])
        innovation = symbol(p * (numbers.z[j] - at_mean) if samples else numbers.z[j] - p * at_mean)
        across = [symbol(sum((P[i, a] * c[a] for a in range(len(v))), sp.S.Zero)) for i in range(len(v))]
        q = symbol(sum((one * entry for one, entry in zip(c, across, strict=True)), sp.S.Zero))
        s = symbol(1 + p * q)
        terms[j] = q * innovation**2 / (2 * s) - sp.log(s) / 2
        if samples:
            constant = numbers.c[j] if fixed else -sp.log(2 * sp.pi * model.observation_noise[j, j]) / 2
            terms[j] += constant - p * (numbers.z[j] - at_mean) ** 2 / 2
        else:
            terms[j] += numbers.z[j] * at_mean - p * at_mean**2 / 2
        gain = symbol(innovation / s), symbol(p / s)
        moved = [symbol(change + entry * gain[0]) for change, entry in zip(moved, across, strict=True)]
        for a, b in block.pairs:
            P[a, b] = P[b, a] = symbol(P[a, b] - across[a] * across[b] * gain[1])
    return Updated(terms, moved, P, defined)


class ConditionalLaw(Law):
    """The law of a sample given u, with v integrated out."""

    def __init__(self, model: Model, block: Block):
        self.block, self.more = block, block.symbols
        self.rows = [j for j in range(model.m) if reads(model, j, list(block.linear))]
        super().__init__(model)
        slopes = [[sp.diff(h, symbol) for symbol in block.v(model)] for h in model.observation]
        self._slopes = numpy_function(sp.Matrix(slopes), model, (model.m, len(block.linear)))

    def spread(self, x: Array, t: float, theta: Array, u: Array | None) -> Any:
        """Return C P C' (m, m) at a point of (x, P), zero at a point of x."""
        n = self.model.n
        if len(x) == n:
            return 0.0
        C = np.asarray(self._slopes(x[:n], t, theta, u))
        return C @ covariances(self.block, x[n:, None])[0] @ C.T

    def _formulas(self, shapes: list[sp.Expr]) -> tuple[list[sp.Expr], list[list[int]]]:
        terms, places = super()._formulas(shapes)
        own, _, _, self.defined = updated(self.model, self.block, self.numbers, self.rows)
        for k, place in enumerate(places):
            if place[0] in own and len(place) == 1:
                terms[k] = own[place[0]]
        return terms, places


class ConditionalSystem(System):
    """A system whose coordinates are the states, the linear ones by their mean, and the entries of their covariance."""

    def __init__(self, model: Model, linear: tuple[int, ...]):
        self.block = Block.of(linear)
        self.drawn_states = np.array([i for i in range(model.n) if i not in linear])
        super().__init__(model)
        self.linear, more = len(linear), len(self.block.pairs)
        self.n = model.n + more
        self.box = (np.append(self.box[0], np.full(more, -np.inf)), np.append(self.box[1], np.full(more, np.inf)))
        self.angles = np.append(self.angles, np.zeros(more, bool))
        for k, (i, j) in enumerate(self.block.pairs):
            if i == j:
                self.owners[linear[i], 2] = model.n + k
        others = [(linear[i], linear[j], -1) for i, j in self.block.pairs]
        self.owners = np.append(self.owners, np.array(others).reshape(-1, 3), axis=0)

    def _set_formulas(self) -> None:
        model, block = self.model, self.block
        linear, P, v = list(block.linear), block.P, block.v(model)
        noise, gain, information = _noise(model, block)
        # About the linear states in the path of the others, per unit time.
        self.information = Expressions([information], model, (), block.symbols) if information != 0 else None
        B = sp.Matrix(len(v), len(v), lambda i, j: sp.diff(model.drift[linear[i]], v[j]))
        rate = B * P + P * B.T + sp.Matrix(model.covariance).extract(linear, linear) - gain * gain.T
        drift, potential, given = list(model.drift), list[sp.Expr](), list[sp.Symbol]()
        if not self.sampled:
            h, (r, Po) = sp.Matrix(model.observation), self.numbers[:2]
            C = sp.Matrix(model.m, len(v), lambda i, j: sp.diff(h[i], v[j]))
            for i, change in zip(linear, P * C.T * (sp.Matrix(r) - Po * h), strict=True):
                drift[i] += change
            rate -= P * C.T * Po * C * P
            potential = [self._factor() - (C.T * Po * C * P).trace() / 2]
            given = [*r, *(Po[pair] for pair in self.numbers.pairs)]
        self._set_motion(noise, [*drift, *(rate[pair] for pair in block.pairs)], potential, given)
        self._set_observation([j for j in range(model.m) if reads(model, j, linear)])

    def _set_observation(self, rows: list[int]) -> None:
        model, block = self.model, self.block
        if self.sampled:
            self.law = ConditionalLaw(model, block)
            numbers, known = self.law.numbers, self.law.numbers.symbols
        else:
            numbers, known = self.numbers, (*self.numbers.z, *(self.numbers.P[pair] for pair in self.numbers.pairs))
        found = updated(model, block, numbers, rows)
        if not self.sampled:
            plain = [numbers.z[j] * h - numbers.P[j, j] * h**2 / 2 for j, h in enumerate(model.observation) if j in rows]
            whole = self._factor() + sum(found.terms.values(), sp.S.Zero) - sum(plain, sp.S.Zero)
            self.factor = Expressions([whole], model, known, block.symbols, found.defined)
        after = list(model.x)
        for i, change in zip(block.linear, found.mean, strict=True):
            after[i] += change
        after += [found.P[pair] for pair in block.pairs]
        self.update = Expressions(after, model, known, block.symbols, found.defined)

    def widened(self, mean: Array, cov: Array) -> Array:
        """Return the covariance (n, n) of the states from that of the particles and the mean (n',) of the coordinates."""
        cov, linear, n = cov.copy(), self.block.linear, self.model.n
        cov[np.ix_(linear, linear)] += covariances(self.block, mean[n:, None])[0]
        return cov

    def scales(self, cov: Array) -> Array:
        """Return standard deviations (n',) of the coordinates, or what is one to them, from the covariance of the states."""
        sd = np.sqrt(np.maximum(np.diag(cov), 0.0))
        own = sd[list(self.block.linear)]
        return np.append(sd, [own[i] * own[j] for i, j in self.block.pairs])

    def gaussian_prior(self, prior: Any) -> tuple[Array, Array] | None:
        """Return the mean (n',) and a root (n', d) of the covariance of a Gaussian prior, None for another one."""
        if not isinstance(prior, GaussianPrior):
            return None
        mean, spread, P = self._conditional(np.array(prior.mean, float), np.array(prior.cov, float))
        return np.append(mean, P), np.vstack([spread, np.zeros((len(P), spread.shape[1]))])

    def drawn(self, prior: Any, theta: Array, count: int, rng: np.random.Generator) -> Array:
        """Return coordinates (n', count) drawn from a prior that is not Gaussian."""
        out = np.zeros((self.n, count))
        if not isinstance(prior, MixturePrior):
            out[: self.model.n] = super().drawn(prior, theta, count, rng)
            return out
        which = rng.choice(len(prior.weights), count, p=np.array(prior.weights) / np.sum(prior.weights))
        for k, (mean, cov) in enumerate(zip(prior.means, prior.covs, strict=True)):
            own = np.flatnonzero(which == k)
            centre, spread, P = self._conditional(np.array(mean, float), np.array(cov, float))
            out[: self.model.n, own] = centre[:, None] + spread @ rng.standard_normal((spread.shape[1], len(own)))
            out[self.model.n :, own] = P[:, None]
        return out

    def _conditional(self, mean: Array, cov: Array) -> tuple[Array, Array, Array]:
        """Return the mean (n,) and the spread (n, d) of u and E(v | u) for a Gaussian, and the entries of the covariance of v."""
        u, v = self.drawn_states, np.array(self.block.linear)
        R = root(cov[np.ix_(u, u)])
        along = np.linalg.lstsq(R, cov[np.ix_(u, v)], rcond=None)[0].T if R.shape[1] else np.zeros((len(v), 0))
        spread = np.zeros((len(mean), R.shape[1]))
        spread[u], spread[v] = R, along
        P = cov[np.ix_(v, v)] - along @ along.T
        return mean, spread, np.array([P[pair] for pair in self.block.pairs])


def _noise(model: Model, block: Block) -> tuple[Noise, sp.Matrix, sp.Expr]:
    """Return the fields of the noise of (u, m, P), the gain K of m by it, and tr(R^-1 A P A' R'^-1)."""
    linear, n, information = list(block.linear), model.n, sp.S.Zero
    G = sp.Matrix(model.covariance)
    if not is_coupled(model, linear):
        g, Q = sp.Matrix(model.diffusion), sp.Matrix(model.process_noise)
        used = [b for b in range(g.cols) if any(g[i, b] != 0 for i in range(n) if i not in linear)]
        fields = sp.Matrix(n, len(used), lambda i, b: 0 if i in linear else g[i, used[b]])
        gain, Q = sp.zeros(len(linear), len(used)), Q.extract(used, used)
    else:
        noisy, v = noisy_others(model, linear), block.v(model)
        R = G.extract(noisy, noisy).cholesky(hermitian=False)
        A = sp.Matrix(len(noisy), len(v), lambda i, j: sp.diff(model.drift[noisy[i]], v[j]))
        gain, Q = R.lower_triangular_solve(A * block.P + G.extract(noisy, linear)).T, sp.eye(len(noisy))
        seen = R.lower_triangular_solve(A)
        information = (seen * block.P * seen.T).trace()
        rows = {i: R.row(a) for a, i in enumerate(noisy)} | {i: gain.row(a) for a, i in enumerate(linear)}
        fields = sp.Matrix(n, len(noisy), lambda i, b: rows[i][b] if i in rows else 0)
    fields = fields.col_join(sp.zeros(len(block.pairs), fields.cols))
    return Noise(fields, Q, (*model.x, *block.symbols), block.symbols), gain, information


def covariances(block: Block, entries: Array) -> Array:
    """Return covariances (N, k, k) from their entries (pairs, N)."""
    k = len(block.linear)
    P = np.empty((entries.shape[1], k, k))
    for (i, j), row in zip(block.pairs, entries, strict=True):
        P[:, i, j] = P[:, j, i] = row
    return P


def conditional_system(model: Model) -> System:
    """Return the system of particles that carry a Kalman filter where that is possible, else the plain one; made once."""
    linear = split_of(model).linear
    return kept(model, ConditionalSystem, lambda: ConditionalSystem(model, linear)) if linear else system_of(model)
