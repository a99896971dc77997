"""What the filters of other libraries take, what they refuse, and what they say of themselves."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import zakai
from peers.systems import FEW, LINEAR, SPIRAL, linear, record_of, spiral
from zakai import _registry
from zakai.algebra.theorems import theorem_of
from zakai.cli import main

TIMES = np.cumsum([0.1, 0.05, 0.2, 0.1, 0.1, 0.15, 0.05, 0.1, 0.3, 0.1])


@pytest.mark.parametrize("name", _registry.PEERS)
def test_a_peer_has_its_own_name_its_theorem_and_is_never_taken_by_auto(name):
    method = _registry.load(name)
    assert method.name == name and method.theorem is theorem_of(name)
    assert name not in _registry.AUTO and name not in _registry.METHODS


def test_a_peer_leaves_the_precision_of_everything_else_alone():
    said = "import jax, zakai._registry as r; [r.load(name) for name in r.PEERS]; print(jax.config.jax_default_matmul_precision)"
    assert subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True).stdout == "None\n"


@pytest.mark.parametrize(("name", "library"), [("ekf", "dynamax"), ("particle", "cuthbert")])
def test_a_library_that_is_not_installed_is_said_in_a_line_with_the_extra(name, library, monkeypatch, tmp_path, capsys):
    for module in [one for one in sys.modules if one.partition(".")[0] == library or one.startswith("zakai.peers")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(zakai.InputError, match=rf"{name}: {library} is not installed.*pip install 'zakai\[peers\]'"):
        _registry.load(name)
    (tmp_path / "record.csv").write_text("time,y1,y2\n0.1,0.0,0.1\n")
    record, result = str(tmp_path / "record.csv"), str(tmp_path / "result.nc")
    assert main(["filter", "gallery:spiral-sensor", record, "--method", name, "-o", result]) == 2
    said = capsys.readouterr().err
    assert "zakai[peers]" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("ekf", {"scheme": "milstein"}, "option scheme"),
        ("ekf", {"substeps": 0}, "option substeps: 0 is not a whole number from 1"),
        ("ukf", {"alpha": 0.0}, "option alpha"),
        ("ukf", {"kappa": -1.0}, "option kappa: -1.0 is not a number above -1"),
        ("ukf", {"beta": "two"}, "option beta"),
        ("enkf", {"members": 1}, "option members"),
        ("enkf", {"inflation": -0.1}, "option inflation"),
        ("particle", {"resampling": "residual"}, "is none of systematic, multinomial, killing"),
        ("particle", {"ess_threshold": 1.5}, "option ess_threshold"),
        ("particle", {"particles": True}, "option particles"),
        ("particle", {"seed": -1}, "option seed"),
        ("particle", {"members": 10}, 'particle has no option "members"'),
    ],
)
def test_an_option_that_cannot_be_is_refused(name, options, said):
    with pytest.raises(zakai.InputError, match=said):
        zakai.filter(spiral("samples"), record_of(spiral("samples"), TIMES), name, **options)


def test_sigma_points_need_a_prior_that_is_not_singular():
    model = zakai.Model(observation_kind="samples", **(SPIRAL | {"prior": {"kind": "gaussian", "mean": [0.3], "cov": [[0.0]]}}))
    with pytest.raises(zakai.InputError, match="prior: its covariance is singular"):
        zakai.filter(model, record_of(model, TIMES), "ukf")


def test_a_density_in_three_coordinates_cannot_be_drawn_from():
    names = ["x", "y", "z"]
    prior = {"kind": "density", "log_density": "-x**2 - y**2 - z**2"}
    model = zakai.Model(state=names, drift=["0"] * 3, observation=names, observation_kind="samples", prior=prior)
    with pytest.raises(zakai.InputError, match="cannot be drawn from"):
        zakai.filter(model, zakai.Record([1.0], [[0.0, 0.0, 0.0]], "samples"), "particle")


def test_the_particle_filter_is_the_same_again_with_its_seed():
    model, options = spiral("increments"), FEW["particle"]
    record = record_of(model, TIMES)
    first, again = (zakai.filter(model, record, "particle", **options) for _ in range(2))
    other = zakai.filter(model, record, "particle", seed=1, **options)
    assert np.array_equal(first.mean, again.mean) and first.log_likelihood == again.log_likelihood
    assert 0 < np.abs(first.mean - other.mean).max() < 1
    assert np.allclose(first.density(-1).mean(), first.mean[-1], rtol=0, atol=1e-9)
    assert np.allclose(first.density(-1).cov(), first.cov[-1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["ukf", "particle"])
def test_many_records_give_what_each_gives_alone(name):
    model, options = spiral("increments"), FEW.get(name, {})
    records = [record_of(model, TIMES, seed=seed) for seed in range(3)]
    for many, record in zip(zakai.filter(model, records, name, **options), records, strict=True):
        alone = zakai.filter(model, record, name, **options)
        assert np.allclose(many.mean, alone.mean, rtol=0, atol=1e-9)
        assert np.allclose(many.cov, alone.cov, rtol=0, atol=1e-9)
        assert np.isclose(many.log_likelihood, alone.log_likelihood, rtol=0, atol=1e-9)


def test_what_was_not_observed_is_as_if_there_were_no_such_sensor():
    model = linear("samples")
    values = record_of(model, TIMES).values.copy()
    values[:, 0] = np.nan
    values[3] = np.nan
    result = zakai.filter(model, zakai.Record(TIMES, values, "samples"), "ekf")
    assert result.log_likelihood_increments[4] == 0
    parts = dict(observation=["v - x/2"], observation_noise=[["1/5"]])
    keys = ("state", "drift", "diffusion")
    table = {key: value for key, value in LINEAR.items() if key in (*keys, "prior")}
    one = zakai.Model(observation_kind="samples", **table, **parts)
    alone = zakai.filter(one, zakai.Record(TIMES, values[:, 1:], "samples"), "ekf")
    assert np.allclose(result.mean, alone.mean, rtol=0, atol=1e-8)
    assert np.allclose(result.log_likelihood_increments, alone.log_likelihood_increments, rtol=0, atol=1e-8)


def test_increments_paths_and_rates_say_the_same():
    record = record_of(spiral("increments"), TIMES, gaps=False)
    expected = zakai.filter(spiral("increments"), record, "ukf")
    lengths = np.diff(TIMES, prepend=0.0)[:, None]
    for kind, values in (("path", np.cumsum(record.values, axis=0)), ("rates", record.values / lengths)):
        result = zakai.filter(spiral(kind), zakai.Record(TIMES, values, kind), "ukf")
        assert np.allclose(result.mean, expected.mean, rtol=0, atol=1e-8)
        assert np.isclose(result.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-8)


def test_every_way_of_resampling_gives_one_posterior_and_says_how_often():
    model = spiral("increments")
    record = record_of(model, TIMES)
    results = [zakai.filter(model, record, "particle", resampling=how, particles=4000, ess_threshold=1.0) for how in
               ("systematic", "multinomial", "killing")]  # fmt: skip
    for result in results:
        assert result.health["resampled"][2:].all()
        assert np.allclose(result.mean, results[0].mean, rtol=0, atol=0.1)


def test_a_collapse_of_the_particles_is_said():
    model = zakai.Model(observation_kind="samples", **(SPIRAL | {"observation_noise": [["1e-6", "0"], ["0", "1e-6"]]}))
    result = zakai.filter(model, record_of(model, TIMES), "particle", **FEW["particle"])
    assert result.health["effective_sample_size"][1:].min() < 2
    assert any("few particles carry the weight" in said for said in result.warnings)


def test_without_process_noise_the_copies_are_counted_as_one():
    model = zakai.Model(observation_kind="samples", **(SPIRAL | {"process_noise": [["0"]]}))
    record = record_of(model, np.arange(1, 81) / 4)
    result = zakai.filter(model, record, "particle", **FEW["particle"])
    assert result.health["effective_sample_size"][-1] < len(np.unique(result.density(-1).points)) + 1e-9 < 20
    assert any("no process noise" in said for said in result.warnings)
    assert any("few particles carry the weight" in said for said in result.warnings)


def test_a_filter_that_lost_the_state_is_said():
    model = spiral("samples")
    truth, _ = zakai.simulate(model, np.arange(1, 41) / 4, seed=2)
    x = truth.values[1:, 0] + 6.0  # not where the prior is
    values = np.stack([x * np.sin(x), x * np.cos(x)], axis=1)
    result = zakai.filter(model, zakai.Record(truth.times[1:], values, "samples"), "ekf")
    assert any("innovations are larger" in said for said in result.warnings)
    well = zakai.filter(model, record_of(model, np.arange(1, 41) / 4, seed=2), "ekf")
    assert well.warnings == []


@pytest.mark.parametrize("name", ["ekf", "particle"])
def test_a_sample_at_the_start_and_an_angle_are_taken(name):
    model = zakai.Model(
        state=["a"], drift=["1"], observation=["cos(a)", "sin(a)"], observation_kind="samples", periodic=["a"],
        process_noise=[["1/100"]], observation_noise=[["1/50", "0"], ["0", "1/50"]],
        prior={"kind": "gaussian", "mean": [0.1], "cov": [[0.2]]},
    )  # fmt: skip
    truth, record = zakai.simulate(model, np.arange(0, 65) / 8, seed=1)
    result = zakai.filter(model, record, name, **FEW.get(name, {}))
    error = np.angle(np.exp(1j * (result.mean[-40:, 0] - truth.values[-40:, 0])))
    assert np.sqrt(np.mean(error**2)) < 0.15 and np.abs(result.mean).max() <= np.pi
    assert result.log_likelihood_increments[1] != 0 and (result.variance[-40:] < 0.05).all()
    assert result.density(-1).log_density(result.mean[-1]) > 0
