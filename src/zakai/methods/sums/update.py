"""What a Gaussian-sum method does to one sum in an interval: transition, likelihood, reduction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from zakai.methods._protocol import Info
from zakai.methods.sums.static import Sum
from zakai.methods.sums.system import Factor
from zakai.numerics.flow import Transition
from zakai.numerics.sums.curvature import Curvature, curvature
from zakai.numerics.sums.fits import fit_peaks
from zakai.numerics.sums.mixture import (
    Array,
    Components,
    dot,
    joined,
    moments,
    regression,
    selected,
    shares,
    symmetric,
    weighed,
    wrapped,
)
from zakai.numerics.sums.quadrature import (
    SEARCH,
    Refitted,
    gauss_hermite,
    points,
    refit,
    refit_affine,
    rows_of,
    steepest,
    tilted,
    together,
    without_loss,
)
from zakai.numerics.sums.reduction import FIVE, PRUNED, exchange, gathered, groups, parents_of, split

# How often components are split before a sample, and how many times more of them there may be while it is used.
ROUNDS, SPLIT_FACTOR = 5, 6
# The loss that a component is meant to have at most; a transition that widens it beyond needs more rounds of exchanges.
_FINE, _MOST_ROUNDS = 0.1, 12
# The share of the reach of its nodes beyond which a component that an observation moves is not known.
_REACHED = 0.8
# The largest energy of h, in nats, between two nodes over a component whose share of the largest is more than this.
_STEEP, _COUNTED = 32.0, 1e-2


def move(transition: Transition, v: Components, inputs: Array, angles: tuple[int, ...]) -> Components:
    """Return every component after the transition: weigh by exp(-z'Omega z / 2 + eta.z + c), map, add noise."""
    offset, vector = transition.offset @ inputs, transition.vector @ inputs
    constant = inputs @ transition.constant @ inputs
    if np.any(transition.information) or np.any(vector):
        v = weighed(v, constant, vector, transition.information)
    else:
        v = v._replace(log_weights=v.log_weights + constant)
    covs = symmetric(transition.map @ v.covs @ transition.map.T) + transition.noise
    return Components(v.log_weights, wrapped(v.means @ transition.map.T + offset, angles), covs, v.signs)


def average(share: Array, figures: Array) -> float:
    """Return the average of a figure of each component."""
    return float(np.sum(np.where(share.real > 0, share.real * figures, 0.0)))


def losses(curved: Curvature, share: Array) -> Array:
    """Return how badly one Gaussian serves each component (K,): what is not linear, against a typical linear part."""
    return curved.residual / (average(share, curved.linear) + 1e-300)


@dataclass(frozen=True, eq=False)
class Moment:
    """A time with the parameters, S^-1 (m, m), the inputs and the observation there, for what is done to a sum at that time."""

    static: Sum
    time: float
    theta: Array
    precision: Array
    inputs: Array | None = None
    values: Array | None = None

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
        return self.static.system.observe(z, self.time, self.theta.real, self.inputs, self.values)

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
                    h = static.system.observe(z, t, theta, factor.inputs)
                    if linear is not None:
                        value = value + h @ linear[j]
                    if energy is not None:
                        away = h - target
                        value = value - 0.5 * dot(away @ energy[j], away)
                return np.asarray(value)

            return refit(v, log_factor, static.directions, energy is not None, corrections)
        for j, t in enumerate(factor.times):
            C, c = static.system.slope(t, theta, factor.inputs)
            if linear is not None:
                v = tilted(v, linear[j] @ C, linear[j] @ c)
            if energy is not None:
                v = refit_affine(v, C, c - target, energy[j])
        return without_loss(v._replace(log_weights=v.log_weights + constant))

    def update(
        self, v: Components, factor: Factor, values: Array, most: int, edge: Array, moved: float
    ) -> tuple[Components, Info]:
        """Return the sum after the factor at the end of an interval, at most `most` components, and what the step reports."""
        self, static = replace(self, values=values.real), self.static
        curved = bool(static.directions.shape[1])
        health = dict.fromkeys(("nonlinearity", "quadrature", "pruned", "merged"), 0.0)
        health["without_law"] = 0.0 if factor.law is None else self._share(v, partial(_lawless, factor.law, values))
        remaining, at_once = 1.0, None
        while remaining > 0.0:
            if curved and static.split_merge and (static.system.sampled or factor.energy is not None):
                fraction = min(remaining, self._fraction(v, factor))
                if fraction < 1.0 == remaining and static.system.sampled:
                    at_once = self.share(self.multiply(v, factor, values).sum)[1].real
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
        if at_once is not None:
            health["quadrature"] = max(health["quadrature"], abs(float(np.tanh(at_once - log_mass.real))))
        if curved and not static.split_before:
            v = self._reduced(v, most, health)
        v, u, parts = self.normalised(v)
        share = parts.reshape(len(v.signs), -1).sum(axis=1).real
        mean, cov = moments(parts, u.means, u.covs, static.angles)
        health |= {
            "tail_depth": moved / _REACHED,
            "components": float(1.0 / np.sum(share**2)),
            "outside_tables": self._share(v, self._beyond) if static.system.outside else 0.0,
            "edge_weight": float(np.sum(share * edge)) if len(edge) == len(share) else 0.0,
        }
        return v, Info(log_mass, wrapped(static.system.origin + mean, static.angles), cov, health)

    def _share(self, v: Components, marked: Callable[[Array], Array]) -> float:
        """Return the share of the mass at points (K, Q, n) that are `marked` (K, Q)."""
        directions = self.static.directions
        rule = gauss_hermite(directions.shape[1])
        real = Components(*(array.real for array in v))
        return average(self.share(v)[0], marked(points(real, regression(real.covs, directions), rule.nodes)) @ rule.weights)

    def _beyond(self, z: Array) -> Array:
        """Return which points lead beyond the range of a table."""
        system = self.static.system
        return system.outside(system.origin + z, self.time, self.theta.real, self.inputs)

    def _fraction(self, v: Components, factor: Factor) -> float:
        """Return the power of a factor, 1/2^i, that is smooth enough for the nodes over the components that count."""
        if factor.energy is None:
            return 1.0
        share = self.share(v)[0].real
        counted = share > _COUNTED * np.max(share, initial=0.0)
        v, directions = selected(v, counted), self.static.directions
        law, values = factor.law, self.values
        if law is not None and values is not None and self.static.system.law_is_formula:
            steep = 2.0 * factor.share * steepest(v, lambda z: np.asarray(law(z, values)), directions)
        else:
            metric = np.abs(factor.energy.real).sum(axis=0) + 1e-300 * np.eye(len(self.precision))
            energies = curvature(v, self.observe, metric, directions)
            steep = float(np.max(energies.residual + energies.linear, initial=0.0)) * SEARCH[directions.shape[1]][1] ** 2
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


def _lawless(law: Callable[[Array, Array], Array], values: Array, z: Array) -> Array:
    """Return at which points a law has no value."""
    return np.asarray(np.isnan(law(z, values).real))


def part_of(factor: Factor, fraction: float) -> Factor:
    """Return a factor to the power of a fraction."""
    if fraction == 1.0:
        return factor
    after, energy = (None if array is None else fraction * array for array in (factor.after, factor.energy))
    if factor.law is not None:
        return factor._replace(energy=energy, share=fraction * factor.share)
    return factor._replace(after=after, energy=energy, weight=fraction * factor.weight, offset=fraction * factor.offset)
