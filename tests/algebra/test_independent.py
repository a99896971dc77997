"""Which blocks of a system are independent, given the prior too, and which of them are the same."""

import numpy as np
import pytest
import sympy as sp

import zakai
from zakai.algebra.choice import divided
from zakai.algebra.independent import independent_blocks
from zakai.errors import ConditionError
from zakai.models.prior import GaussianPrior, MixturePrior


def system(prior, **keys):
    plain = {"state": ["x", "y", "z"], "drift": ["-x", "-y", "-z"], "observation": ["x", "y", "z"]}
    return zakai.Model(**{**plain, "prior": prior, **keys})


def found(prior, **keys):
    model = system(prior, **keys)
    return independent_blocks(model, model.prior)


def names(blocks):
    return [block.names for block in blocks]


def test_correlation_couples():
    blocks = found({"kind": "gaussian", "mean": [1, 2, 3], "cov": [[1, 0, 0.5], [0, 4, 0], [0.5, 0, 2]]})
    assert names(blocks) == [("x", "z"), ("y",)]
    assert blocks[0].prior.mean.tolist() == [1, 3] and blocks[0].prior.cov.tolist() == [[1, 0.5], [0.5, 2]]
    assert blocks[1].prior.mean.tolist() == [2] and blocks[1].prior.cov.tolist() == [[4]]


def mixture(means, weights, covs=None):
    return {"kind": "mixture", "weights": weights, "means": means, "covs": covs or [[1, 1, 1]] * len(weights)}


def test_the_components_of_a_mixture_couple_unless_they_factorise():
    one = found(mixture([[0, 1, 2]], [1]))
    assert names(one) == [("x",), ("y",), ("z",)] and all(isinstance(block.prior, GaussianPrior) for block in one)
    two = found(mixture([[0, 0, 0], [0, 1, 0]], [0.25, 0.75]))
    assert names(two) == [("x",), ("y",), ("z",)]
    assert isinstance(two[1].prior, MixturePrior) and two[1].prior.weights.tolist() == [0.25, 0.75]
    assert names(found(mixture([[0, 0, 0], [1, 1, 0]], [0.25, 0.75]))) == [("x", "y"), ("z",)]
    # Every pair of means, with weights that are products, and then with others.
    grid = [[a, b, 0] for a in (0, 1) for b in (0, 1)]
    free = found(mixture(grid, [0.06, 0.14, 0.24, 0.56]))
    assert names(free) == [("x",), ("y",), ("z",)]
    assert np.allclose(free[0].prior.weights, [0.2, 0.8]) and np.allclose(free[1].prior.weights, [0.3, 0.7])
    assert names(found(mixture(grid, [0.1, 0.2, 0.3, 0.4]))) == [("x", "y"), ("z",)]
    correlated = [np.eye(3).tolist(), [[1, 0, 0.5], [0, 1, 0], [0.5, 0, 1]]]
    assert names(found(mixture([[0, 0, 0]] * 2, [0.5, 0.5], correlated))) == [("x", "z"), ("y",)]


def test_three_coordinates_that_are_independent_in_pairs_only_stay_together():
    # z is the exclusive or of x and y.
    means = [[a, b, a ^ b] for a in (0, 1) for b in (0, 1)]
    assert names(found(mixture(means, [0.25] * 4))) == [("x", "y", "z")]


def test_a_density_splits_where_its_logarithm_is_a_sum():
    x, z = sp.symbols("x z", real=True)

    def density(text):
        return {"kind": "density", "log_density": text}

    blocks = found(density("-(x**2 + y**2)/2 - z**4 + 7"))
    assert names(blocks) == [("x",), ("y",), ("z",)] and blocks[2].prior.log_density == -(z**4)
    # Blocks that share a model have their prior in its names.
    assert blocks[1].model is blocks[0].model and blocks[1].prior.log_density == -(x**2) / 2
    assert names(found(density("-(x - y)**2 - x**2 - z**2"))) == [("x", "y"), ("z",)]
    assert names(found(density("-(x + y)*(x - y) - 2*y**2 - z**2"))) == [("x",), ("y",), ("z",)]
    assert names(found(density("-x**2*(1 + y**2) - y**2 - z**2 - abs(z)"))) == [("x", "y"), ("z",)]


def test_blocks_with_the_same_formulas_share_one_model():
    keys = {
        "state": ["p", "q", "r", "s", "u"],
        "drift": ["a*p", "b*q", "r/2", "c*s", "cos(u)"],
        "observation": ["q", "p", "r", "2*s", "u"],
        "parameters": {"a": 0.5, "b": 0.5, "c": 0.5},
    }
    model = zakai.Model(**keys, prior={"kind": "gaussian", "mean": [0, 1, 2, 3, 4], "cov": [1, 1, 2, 1, 1]})
    first, second, third, fourth, fifth = independent_blocks(model, model.prior)
    assert first.model is second.model is third.model
    assert len({id(block.model) for block in (first, fourth, fifth)}) == 3
    assert (first.observations, second.observations) == ((1,), (0,)) and second.names == ("q",)
    # What is decided offline for the three is decided for a prior that has all of them in it.
    assert np.isclose(first.model.prior.mean[0], 1.0) and np.isclose(first.model.prior.cov[0, 0], 4 / 3 + 2 / 3)
    apart = independent_blocks(model, model.prior, by_value=False)
    assert len({id(block.model) for block in apart[:3]}) == 3


def test_a_named_method_is_taken_for_the_whole_where_it_holds():
    model = system({"kind": "gaussian", "mean": [0, 0, 0], "cov": [1, 1, 1]})
    assert divided(model, model.prior) is None and divided(model, model.prior, "kalman-bucy") is None
    curved = system(None, observation=["x**2", "y**2", "z**2"], drift=["0"] * 3, observation_kind="samples")
    assert divided(curved, curved.prior).method == "blocks: 3 x limited-direct"
    five = zakai.Model(
        state=list("abcde"), drift=["0"] * 5, observation=[f"sin({s})" for s in "abcde"], observation_kind="samples"
    )
    assert "the method asked for holds for each" in divided(five, None, "limited-direct").why
    assert "a, b, c and 2 more by limited-direct" in divided(five, None, "limited-direct").why


def test_a_block_without_a_method_is_named():
    model = zakai.Model(state=["x", "y"], drift=["-x", "y - y**3"], observation=["x", "sin(y)"])
    with pytest.raises(ConditionError, match="kalman-bucy does not hold: it fails that .* nor block by block: .*block y"):
        divided(model, None, "kalman-bucy")


def test_a_thousand_blocks_are_found_in_seconds():
    n = 1000
    states = [f"x{i}" for i in range(n)]
    prior = {"kind": "gaussian", "mean": [0] * n, "cov": [1] * n}
    model = zakai.Model(
        state=states, drift=[f"cos({s})" for s in states], observation=[f"{s}**3" for s in states], prior=prior
    )
    blocks = independent_blocks(model, model.prior)
    assert len(blocks) == n and len({id(block.model) for block in blocks}) == 1
    assert blocks[-1].names == ("x999",) and blocks[-1].observations == (999,)
