"""What a Gaussian-sum method does to one sum in an interval: transition, likelihood, reduction."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.methods._protocol import Info
from zakai.methods._sum_gauge import SumGauge, directions_of, span
from zakai.methods._sum_system import Factor, System, system_of
from zakai.models.model import Model
from zakai.numerics.flow import Transition
from zakai.numerics.gaussian_sum import (
    Array,
    Components,
    dot,
    joined,
    log_volumes,
    moments,
    regression,
    selected,
    shares,
    solve,
    symmetric,
    wrapped,
)
from zakai.numerics.sum_curvature import Curvature, curvature
from zakai.numerics.sum_fits import fit_dictionary, fit_peaks
from zakai.numerics.sum_quadrature import (
    SEARCH,
    Refitted,
    gauss_hermite,
    points,
    refit,
    refit_affine,
    rows_of,
    tilted,
    together,
    without_loss,
)
from zakai.numerics.sum_reduction import FIVE, PRUNED, exchange, gathered, groups, parents_of, split

# Components by the number of directions in which they must be narrow.
COMPONENTS = {0: 1, 1: 20, 2: 64, 3: 128}
MOST_DIRECTIONS = 5
# Up to so many directions the start of an affine h, which is exact from there on, is not reduced.
MOST_WHOLE = 2
# How often components are split before a sample, and how many times more of them there may be while it is used.
ROUNDS, SPLIT_FACTOR = 5, 6
# The share of the components that the companion has.  The error falls about like the inverse of their number, so that the
# distance of the two is about the error of the longer one, or more.
_COMPANION = 0.35
# The loss that a component is meant to have at most; a transition that widens it beyond needs more rounds of exchanges.
_FINE, _MOST_ROUNDS = 0.1, 12
# The share of the reach of its nodes beyond which a component that an observation moves is not known.
_REACHED = 0.8
# The largest energy of h, in nats, between two nodes over a component whose share of the largest is more than this.
_STEEP, _COUNTED = 32.0, 1e-2


class Sum:
    """What does not depend on data or parameters: the system, its gauge, and how the sum is kept."""

    def __init__(self, model: Model, splitting: str, components: int | None, reduction: str, tolerance: float, alpha: float):
        self.model = model
        self.system: System = system_of(model, splitting)
        self.gauge = SumGauge(self.system.potential, model, self.system.origin)
        self.angles = tuple(model.state.index(name) for name in model.periodic)
        self.affine = self.system.affine
        formulas = list(model.observation) if self.system.law is None else self.system.law.formulas
        self.directions = np.zeros((model.n, 0)) if self.affine else directions_of(formulas, model)
        self.start_directions = span(np.hstack([self.directions, self.gauge.directions]))
        k = self.start_directions.shape[1]
        if max(k, self.directions.shape[1]) > MOST_DIRECTIONS:
            raise InputError(
                f"{model.source}: h and phi vary in {k} directions of the state; quadrature takes {MOST_DIRECTIONS} at most"
            )
        self.asked, self.components = components, COMPONENTS.get(k, 192) if components is None else components
        self.reduction, self.tolerance, self.alpha = reduction, tolerance, alpha
        self.split_merge = reduction == "split-merge"
        # The last factor of an interval corrects for what both halves lose; other reductions may have negative parts.
        self.corrections = 1 + self.system.halves if self.split_merge else 0
        # Whether an interval is split in time: its error is that of the companion, which takes two steps of half the length.
        self.split_time = not self.system.rates and not self.system.sampled
        # Whether components are split before each observation rather than after it.
        self.split_before = self.system.sampled and bool(self.directions.shape[1]) and self.split_merge

    def limits(self, count: int) -> tuple[int, int]:
        """Return how many components the sum and its companion may have, for a prior that was cut into `count` Gaussians."""
        k = self.start_directions.shape[1]
        if k == 0 or self.affine and self.asked is None and k <= MOST_WHOLE:  # nothing is merged
            used = count if self.affine else self.components
            return used, used
        used = min(self.components, count) if self.affine else self.components
        return used, round(_COMPANION * used) if used >= 6 else used + 4


@lru_cache(maxsize=32)
def sum_of(model: Model, splitting: str, components: int | None, reduction: str, tolerance: float, alpha: float) -> Sum:
    """Return what does not depend on data or parameters, made once."""
    return Sum(model, splitting, components, reduction, tolerance, alpha)


def move(transition: Transition, v: Components, inputs: Array, angles: tuple[int, ...]) -> Components:
    """Return every component after the transition: weigh by exp(-z'Omega z / 2 + eta.z + c), map, add noise."""
    offset, vector = transition.offset @ inputs, transition.vector @ inputs
    means, covs, logs = v.means, v.covs, v.log_weights + inputs @ transition.constant @ inputs
    if np.any(transition.information) or np.any(vector):
        pulled = means @ transition.information
        system = np.eye(means.shape[1]) + covs @ transition.information
        covs, gradient = symmetric(solve(system, covs)), vector - pulled
        shift = dot(covs, gradient[:, None, :])
        logs = logs + means @ vector - 0.5 * dot(means, pulled) + 0.5 * dot(gradient, shift) - 0.5 * log_volumes(system)
        means = means + shift
    covs = symmetric(transition.map @ covs @ transition.map.T) + transition.noise
    return Components(logs, wrapped(means @ transition.map.T + offset, angles), covs, v.signs)


def average(share: Array, figures: Array) -> float:
    """Return the average of a figure of each component."""
    return float(np.sum(np.where(share.real > 0, share.real * figures, 0.0)))


def losses(curved: Curvature, share: Array) -> Array:
    """Return how badly one Gaussian serves each component (K,): what is not linear, against a typical linear part."""
    return curved.residual / (average(share, curved.linear) + 1e-300)


class Moment(NamedTuple):
    """A time with the parameters and S^-1 (m, m) there, for what is done to a sum at that time."""

    static: Sum
    time: float
    theta: Array
    precision: Array

    def share(self, v: Components) -> tuple[Array, Any]:
        """Return the share in u = e^phi v of each component of v (K,), and the logarithm of the mass of u."""
        share, log_mass = shares(self.static.gauge.lift(v, self.time, self.theta))
        return share.reshape(len(v.signs), -1).sum(axis=1), log_mass

    def normalised(self, v: Components) -> tuple[Components, Components, Array]:
        """Return v so that u = e^phi v has mass one, u, and the shares of the components of u."""
        u = self.static.gauge.lift(v, self.time, self.theta)
        share, log_mass = shares(u)
        return v._replace(log_weights=v.log_weights - log_mass), u, share

    def observe(self, z: Array) -> Array:
        """Return h at points without derivatives."""
        return self.static.system.observe(z, self.time, self.theta.real)

    def curvature(self, v: Components) -> Curvature:
        """Return how far h is from affine over each component."""
        return curvature(v, self.observe, self.precision, self.static.directions)

    def losses(self, v: Components, share: Array) -> Array:
        """Return how badly one Gaussian serves each component (K,)."""
        return losses(self.curvature(v), share) if self.static.directions.shape[1] else np.zeros(len(share))

    def multiply(self, v: Components, factor: Factor, values: Array, corrections: int = 0, start: bool = False) -> Refitted:
        """Return v times the factor of an interval at its `start` or at its end."""
        static, theta = self.static, self.theta
        if factor.law is not None:
            law, share = factor.law, factor.share

            def log_law(z: Array, _: Array) -> Array:
                logs = share * law(z, values)
                return np.where(np.isnan(logs), -np.inf, logs)

            return refit(v, log_law, static.directions, True)
        forces, energy = (factor.before, None) if start else (factor.after, factor.energy)
        constant = 0.0 if start else factor.offset + 0.5 * values @ factor.weight @ values
        linear = None if forces is None or not np.any(values) else forces @ values
        if linear is None and energy is None:
            return without_loss(v._replace(log_weights=v.log_weights + constant))
        target = factor.spread @ values
        if not static.affine:

            def log_factor(z: Array, _: Array) -> Array:
                value: Any = constant
                for j, t in enumerate(factor.times):
                    h = static.system.observe(z, t, theta)
                    if linear is not None:
                        value = value + h @ linear[j]
                    if energy is not None:
                        away = h - target
                        value = value - 0.5 * dot(away @ energy[j], away)
                return np.asarray(value)

            return refit(v, log_factor, static.directions, energy is not None, corrections)
        for j, t in enumerate(factor.times):
            C, c = static.system.slope(t, theta)
            if linear is not None:
                v = tilted(v, linear[j] @ C, linear[j] @ c)
            if energy is not None:
                v = refit_affine(v, C, c - target, energy[j])
        return without_loss(v._replace(log_weights=v.log_weights + constant))

    def update(
        self, v: Components, factor: Factor, values: Array, most: int, edge: Array, moved: float
    ) -> tuple[Components, Info]:
        """Return the sum after the factor at the end of an interval, at most `most` components, and what the step reports."""
        static = self.static
        curved = bool(static.directions.shape[1])
        health = dict.fromkeys(("nonlinearity", "quadrature", "pruned", "merged"), 0.0)
        health["without_law"] = self._without_law(v, factor, values)
        remaining = 1.0
        while remaining > 0.0:
            if curved and static.split_merge and (static.system.sampled or factor.energy is not None):
                fraction = min(remaining, self._fraction(v, factor))
                v, product = self._sharp(v, part_of(factor, fraction), values, most, health)
            else:
                fraction, product = remaining, self.multiply(v, factor, values, static.corrections)
                v = product.sum
            remaining -= fraction
            share, log_mass = self.share(product.sum)
            if not np.isfinite(log_mass):
                raise np.linalg.LinAlgError("the density has no mass")
            health["nonlinearity"] += average(share, product.loss)
            health["quadrature"] += average(share, product.doubt)
            moved = max(moved, average(share, product.moved))
        if curved and not static.split_before:
            v = self._reduced(v, most, health)
        v, u, parts = self.normalised(v)
        share = parts.reshape(len(v.signs), -1).sum(axis=1).real
        mean, cov = moments(parts, u.means, u.covs, static.angles)
        health |= {
            "tail_depth": moved / _REACHED,
            "components": float(1.0 / np.sum(share**2)),
            "edge_weight": float(np.sum(share * edge)) if len(edge) == len(share) else 0.0,
        }
        return v, Info(log_mass, wrapped(static.system.origin + mean, static.angles), cov, health)

    def _without_law(self, v: Components, factor: Factor, values: Array) -> float:
        """Return the share of the mass where the law of a sample has no value."""
        if factor.law is None:
            return 0.0
        directions = self.static.directions
        rule = gauss_hermite(directions.shape[1])
        real = Components(*(array.real for array in v))
        logs = factor.law(points(real, regression(real.covs, directions), rule.nodes), values)
        return average(self.share(v)[0], np.isnan(logs.real) @ rule.weights)

    def _fraction(self, v: Components, factor: Factor) -> float:
        """Return the power of a factor, 1/2^i, that is smooth enough for the nodes over the components that count."""
        if factor.energy is None:
            return 1.0
        share = self.share(v)[0].real
        counted = share > _COUNTED * np.max(share, initial=0.0)
        metric = np.abs(factor.energy.real).sum(axis=0) + 1e-300 * np.eye(len(self.precision))
        energies = curvature(selected(v, counted), self.observe, metric, self.static.directions)
        steep = float(np.max(energies.residual + energies.linear, initial=0.0)) * SEARCH[self.static.directions.shape[1]][1] ** 2
        return float(np.exp2(-np.ceil(np.log2(steep / _STEEP)))) if _STEEP < steep < np.inf else 1.0

    def _sharp(
        self, v: Components, factor: Factor, values: Array, most: int, health: dict[str, float]
    ) -> tuple[Components, Refitted]:
        """Return the sum after a factor that may say much at once, merged to `most` components, and the product before merging.

        The factor multiplies a longer sum, split where its product is not Gaussian.
        """
        static, product = self.static, self.multiply(v, factor, values)
        for _ in range(ROUNDS):
            share = self.share(product.sum)[0].real
            alive = share > PRUNED
            if not np.all(np.isfinite(share)):
                break
            health["pruned"] += float(share[~alive].sum())
            v, product, share = selected(v, alive), rows_of(product, alive), share[alive]
            parents = parents_of(share, product.loss, static.tolerance**2, SPLIT_FACTOR * most)
            if not len(parents):
                break
            rest = np.ones(len(share), bool)
            rest[parents] = False
            chosen = selected(v, parents)
            children = split(chosen, self.curvature(chosen).axes(), FIVE)
            found = self.multiply(children, factor, values)
            v, product = joined(selected(v, rest), children), together(rows_of(product, rest), found)
        v = product.sum
        if len(v.signs) > most:
            share = self.share(v)[0].real
            weight = np.where(share > PRUNED, share, 0.0)
            label, cost = groups(weight, v.means.real, v.covs.real, None, most, static.angles)
            v, health["merged"] = gathered(v, label, static.angles), health["merged"] + cost
        return v, product

    def _reduced(self, v: Components, most: int, health: dict[str, float]) -> Components:
        """Return the sum after an increment: by default after exchanges.

        They are done in four rounds for each halving that the typical loss makes necessary.
        """
        static, rounds, done = self.static, 1, 0
        if static.reduction == "algorithm-1":
            return fit_peaks(v, static.alpha, most)
        if static.reduction == "nnls":
            return fit_dictionary(v, self.share(v)[0], most)
        while done < rounds:
            share = self.share(v)[0].real
            curved = self.curvature(v)
            loss = losses(curved, share)
            if not done:
                typical = average(share, loss)
                rounds = int(np.clip(np.round(4 * np.log2(1 + typical / _FINE)), 1, _MOST_ROUNDS)) if np.isfinite(typical) else 1
            before = len(share)
            v, dropped, paid = exchange(v, share, loss, curved.axes, static.tolerance, most, static.angles)
            health["pruned"] += dropped
            health["merged"] += paid
            done += 1
            if len(v.signs) == before and paid == 0.0:
                break
        return v


def part_of(factor: Factor, fraction: float) -> Factor:
    """Return a factor to the power of a fraction."""
    if fraction == 1.0:
        return factor
    after, energy = (None if array is None else fraction * array for array in (factor.after, factor.energy))
    if factor.law is not None:
        return factor._replace(energy=energy, share=fraction * factor.share)
    return factor._replace(after=after, energy=energy, weight=fraction * factor.weight, offset=fraction * factor.offset)
