"""The blocks of a system whose priors are independent too: each can be filtered by itself."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from zakai.algebra.blocks import Groups, connected, part_of
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.prior import DensityPrior, GaussianPrior, MixturePrior

_ROUNDING = 1e-12  # of the weights of a mixture


@dataclass(frozen=True, eq=False)
class IndependentBlock:
    """A block with a prior of its own.

    `states` and `observations` are its places in the whole, `names` those of its states, and `prior` is what the prior of the
    whole says of them.  Blocks with the same equations share one `model`, whose states have the names of the first of them
    and whose prior is that of all of them, put together if they differ.
    """

    states: tuple[int, ...]
    observations: tuple[int, ...]
    names: tuple[str, ...]
    model: Model
    prior: Any


@once_for_a_model
def independent_blocks(model: Model, prior: Any, by_value: bool = True) -> tuple[IndependentBlock, ...]:
    """Return the connected parts of (f, G, h, S) and of a prior (or None): p(x, t | y) is the product of their densities.

    A Gaussian couples correlated states, a mixture those for which its components do not factorise, a density those that share
    a term of its logarithm. Blocks are equal if their formulas are, up to the names of states and, `by_value`, of parameters.
    """

    def join(groups: Groups) -> None:
        if isinstance(prior, GaussianPrior):
            _join_correlated(groups, prior.cov)
        elif isinstance(prior, MixturePrior):
            _join_correlated(groups, np.any(prior.covs != 0, axis=0))
            _join_components(groups, prior)
        elif isinstance(prior, DensityPrior):
            for term in _terms(model, groups, prior.log_density):
                groups.join(_places(model, term))

    parts = connected(model, join)
    if len(parts) == 1:
        return (IndependentBlock(*parts[0], model.state, model, prior),)
    whole = Groups(model)
    for states, _ in parts:
        whole.join(states)
    values = model.parameters if by_value else {}
    renamed = {symbol: values[symbol.name] for symbol in model.parameter_symbols if symbol.name in values}
    same: dict[Hashable, list[int]] = {}
    known: dict[Hashable, Any] = {}
    priors = []
    for number, (states, rows) in enumerate(parts):
        own = _part_of_prior(model, prior, whole, states)
        priors.append(known.setdefault(_identity(own), own))
        same.setdefault(_formulas(model, states, rows, own, renamed), []).append(number)
    models: dict[int, Model] = {}
    for numbers in same.values():
        shared = part_of(model, *parts[numbers[0]], _pooled([priors[number] for number in numbers]))
        for number in numbers:
            models[number] = shared
            if isinstance(prior, DensityPrior):
                priors[number] = shared.prior  # in the names of the states of the shared model
    return tuple(
        IndependentBlock(states, rows, tuple(model.state[i] for i in states), models[number], priors[number])
        for number, (states, rows) in enumerate(parts)
    )


def _join_correlated(groups: Groups, cov: np.ndarray) -> None:
    for i, j in np.argwhere(np.triu(cov, 1) != 0).tolist():
        groups.join((i, j))


def _join_components(groups: Groups, prior: MixturePrior) -> None:
    """Join the groups between which the components of a mixture are not independent.

    One group after another is parted from the rest, where the weights of the pairs of what the two may be are of rank one.
    """
    which = {states: _components(prior, states)[0] for states, _ in groups.parts()}
    left = [states for states, label in which.items() if label.max() > 0]
    parted = True
    while parted and len(left) > 1:
        parted = False
        for states in left:
            others = np.stack([which[other] for other in left if other != states], axis=1)
            rest = np.unique(others, axis=0, return_inverse=True)[1].ravel()
            table = np.zeros((which[states].max() + 1, rest.max() + 1))
            np.add.at(table, (which[states], rest), prior.weights)
            if np.allclose(table, table.sum(axis=1)[:, None] * table.sum(axis=0), rtol=_ROUNDING, atol=0):
                left.remove(states)
                parted = True
                break
    if len(left) > 1:
        groups.join([states[0] for states in left])


def _components(prior: MixturePrior, states: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Which of its different Gaussians over these states each component (k,) has, and the first component of each."""
    places = list(states)
    covs = prior.covs[:, places][:, :, places].reshape(len(prior.weights), -1)
    _, first, label = np.unique(np.hstack([prior.means[:, places], covs]), axis=0, return_index=True, return_inverse=True)
    return label.ravel(), first


def _places(model: Model, expression: sp.Expr) -> list[int]:
    return [i for i, symbol in enumerate(model.x) if symbol in expression.free_symbols]


def _terms(model: Model, groups: Groups, expression: sp.Expr) -> list[sp.Expr]:
    """The terms of a sum; one that holds states of several groups is multiplied out, in case that parts it."""
    terms: list[sp.Expr] = []
    for term in sp.Add.make_args(expression):
        together = len({groups.root(i) for i in _places(model, term)}) < 2
        terms += [term] if together else sp.Add.make_args(sp.expand(term))
    return terms


def _part_of_prior(model: Model, prior: Any, groups: Groups, states: tuple[int, ...]) -> Any:
    """What a prior that couples no two groups says of one of them."""
    if isinstance(prior, GaussianPrior):
        return GaussianPrior(prior.mean[list(states)], prior.cov[np.ix_(states, states)])
    if isinstance(prior, MixturePrior):
        return _part_of_mixture(prior, states)
    if prior is None:
        return None
    root = groups.root(states[0])
    # A term that is constant normalises nothing.
    places = {term: _places(model, term) for term in _terms(model, groups, prior.log_density)}
    return DensityPrior(sp.Add(*(term for term, used in places.items() if used and groups.root(used[0]) == root)))


def _pooled(priors: Sequence[Any]) -> Any:
    """One prior for all: their own if it is one, or else a Gaussian with the moments of their mixture.

    What is decided offline, such as how finely to divide, is then decided for all of them.
    """
    different = list(dict.fromkeys(priors))
    if len(different) == 1 or isinstance(different[0], DensityPrior):
        return different[0]
    means = np.array([prior.mean for prior in different])
    deviations = means - means.mean(axis=0)
    cov = np.mean([prior.cov for prior in different], axis=0) + deviations.T @ deviations / len(different)
    return GaussianPrior(means.mean(axis=0), cov)


def _part_of_mixture(prior: MixturePrior, states: tuple[int, ...]) -> GaussianPrior | MixturePrior:
    label, first = _components(prior, states)
    means, covs = prior.means[first][:, list(states)], prior.covs[first][:, list(states)][:, :, list(states)]
    if len(first) == 1:
        return GaussianPrior(means[0], covs[0])
    return MixturePrior(np.bincount(label, prior.weights), means, covs)


def _identity(prior: Any) -> Hashable:
    """What is the same for equal priors."""
    if isinstance(prior, GaussianPrior | MixturePrior):
        return type(prior), *(np.ascontiguousarray(array).tobytes() for array in vars(prior).values())
    return type(prior), None if prior is None else prior.log_density


def _formulas(model: Model, states: tuple[int, ...], rows: tuple[int, ...], prior: Any, values: Mapping[Any, Any]) -> Hashable:
    """What is the same for blocks that differ in nothing but the names of their states, and in the numbers of their priors."""
    # No name of a user's begins like this.
    renamed = {**values, **{model.x[i]: sp.Symbol(f"_{k}", real=True) for k, i in enumerate(states)}}
    matrices = [model.covariance.extract(states, states), model.observation_noise.extract(rows, rows)]
    families = tuple(model.observation_family[i] for i in rows)
    kinds = families, tuple(model.domain.get(model.state[i]) for i in states)
    formulas = [
        *(model.drift[i] for i in states),
        *(model.observation[i] for i in rows),
        *(entry for matrix in matrices for entry in matrix),
        *(formula for (_, i), formula in model.family_parameters.items() if i in rows),
        *([prior.log_density] if isinstance(prior, DensityPrior) else []),
    ]
    angles = tuple(model.state[i] in model.periodic for i in states)
    return len(states), len(rows), type(prior), angles, kinds, tuple(formula.xreplace(renamed) for formula in formulas)
