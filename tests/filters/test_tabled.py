"""Steps with tables: against steps on a lattice that moves, and what a table is made of against its own definition."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import zakai
from zakai.filters import _splitting as splitting
from zakai.filters import _tabled as tabled
from zakai.filters import yau_yau
from zakai.filters.observations import Whole

WELL = dict(
    name="double well",
    state=["x"],
    diffusion=[["0.7"]],
    observation=["x"],
    prior={"kind": "gaussian", "mean": [0.4], "cov": [0.2]},
)


def wells(**keys) -> tuple[zakai.Model, zakai.Model]:
    """A model whose steps are tabled, and the same with a drift of which that is not known."""
    return zakai.Model(drift=["x - x**3"], **WELL | keys), zakai.Model(drift=["x - x**3 + 1e-30*t"], **WELL | keys)


@pytest.mark.slow
@pytest.mark.parametrize(
    "keys",
    [
        dict(),
        dict(observation_kind="samples", observation_noise=[[0.1]]),
        dict(observation=["x", "x**2"], observation_noise=[["0.2", "0.1"], ["0.1", "0.3"]]),
    ],
    ids=["increments", "samples", "two sensors whose noise is correlated"],
)
def test_a_lattice_that_stands_still_gives_what_one_that_moves_gives(keys):
    model, moving = wells(**keys)
    values = np.array(zakai.simulate(model, 0.02 * np.arange(1, 41), seed=3)[1].values)
    values[10:12] = np.nan
    record = zakai.Record(0.02 * np.arange(1, 41), values, model.observation_kind)
    one, other = (zakai.filter(each, record, "yau-yau", tolerance=1e-6, substeps=4) for each in (model, moving))
    # On a lattice that stands still there is no error of steps in time.
    assert np.nanmax(one.health["time_error"]) == 0 < np.nanmax(other.health["time_error"])
    assert not one.warnings
    assert np.abs(one.mean - other.mean).max() < 2e-6
    assert np.abs(one.variance / other.variance - 1).max() < 5e-6
    assert abs(one.log_likelihood - other.log_likelihood) < 5e-6


def test_what_a_table_tells_is_what_its_parts_say():
    model, _ = wells(observation=["x", "x**2"])
    centre, cell, size, tau = 0.25, 0.0625, 64, 0.01
    table = yau_yau.System(model).tables.of(centre, cell, size, tau, model.theta())
    z = np.arange(size) - size // 2.0
    x = centre + cell * z
    factor = Whole(np.array([0.3, -0.2]), np.array([[0.1, 0.04], [0.04, 0.2]]), 0.0, 1.0)
    h = np.stack([x, x**2])
    log = factor.linear @ h - 0.5 * np.sum(h * (factor.energy @ h), axis=0)
    b = tabled.likelihood(table, jax.tree.map(lambda a: np.asarray(a)[None], factor), np.ones(1))
    assert np.allclose(b.log[0], log, atol=1e-14)
    values = np.exp(-8 * (x - 0.5) ** 2)
    spread = np.array([[0.49 / cell**2]])
    for scheme in (splitting.STRANG, splitting.CHIN):
        told = tabled.told(table, values[None, ::-1], values[None], b, scheme)
        terms = splitting.terms(log, values, [(x - x**3) / cell], spread, scheme)
        assert np.allclose([np.ravel(part) for part in told.terms], np.array(terms)[:, None], rtol=1e-9)
        for share, undone in scheme.factors:
            own, other = tabled.corrected(b, tau, share, undone), splitting.corrected(log, spread, tau, share, undone)
            assert np.allclose(own[0], other, atol=1e-13)
    mean = values @ z / values.sum()
    assert np.allclose([told.mean[0], told.variance[0]], [mean, values @ (z - mean) ** 2 / values.sum()], rtol=1e-12)


def test_drift_that_flows_apart_where_the_ends_of_a_lattice_meet_does_not_grow():
    model, _ = wells()
    table = yau_yau.System(model).tables.of(0.0, 0.125, 128, 0.01, model.theta())
    assert np.abs(np.linalg.eigvals(table.transition)).max() < 1 + 1e-9


def test_what_depends_on_the_time_or_is_not_a_number_has_no_table():
    model, moving = wells()
    assert yau_yau.System(moving).tables is None
    roots = yau_yau.System(zakai.Model(drift=["sqrt(x)"], **WELL))
    assert roots.tables.of(0.0, 0.125, 64, 0.01, model.theta()) is None


def test_a_state_that_comes_back_finds_its_table():
    model, _ = wells()
    record = zakai.simulate(model, 0.01 * np.arange(1, 2001), seed=1)[1]
    result = zakai.filter(model, record, "yau-yau", keep="moments")
    # No window was so wide that the drift at its ends was too steep for a table.
    assert np.nanmax(result.health["time_error"]) == 0
    tables = yau_yau._system(yau_yau.formulas(model)).tables
    made = len(tables.kept)
    zakai.filter(model, record, "yau-yau", keep="moments")
    assert 0 < made == len(tables.kept) < 40


@pytest.mark.parametrize("splits", [1, 3])
def test_a_number_of_parts_that_the_compiler_knows_changes_nothing(splits):
    rng, size, count = np.random.default_rng(0), 64, 5
    z = np.arange(size) - size // 2.0
    model, _ = wells()
    table = yau_yau.System(model).tables.of(0.0, 0.1, size, 0.01, model.theta())
    values = np.exp(-0.1 * (z - 3) ** 2)
    factors = [0.01 * rng.normal(size=(count, 1)) * z - 1e-4 * z**2 for _ in range(3)]
    one, other = (tabled.passed(table, values, factors, 2 * factors[-1], splits, known) for known in (splits, 0))
    for a, b in zip(one, other, strict=True):
        assert np.allclose(a, b, rtol=1e-12, atol=1e-15)
    # By the definition: no sum of logarithms, no part that is merged with the next.
    plain = values
    for k in range(count):
        for part in range(splits):
            plain = table.transition @ (plain * np.exp(factors[0][k]))
            plain = table.transition @ (plain * np.exp(factors[1][k]))
            plain = plain * np.exp((2.0 if part == splits - 1 else 1.0) * factors[2][k])
    end = np.exp(np.sum(one.gained) + 2 * factors[2][-1]) * one.after[-1]
    assert np.abs(end - plain).max() < 1e-11 * plain.max()
