"""The reproductions that filter, run in small: what they compile takes seconds."""

from __future__ import annotations

import numpy as np
import pytest

from zakai import studies
from zakai.studies import cubic_sensor, lorenz_63_sakov_2012, tracking


def verdicts(reproduction) -> list[str]:
    return [comparison.verdict.partition(",")[0].partition(":")[0] for comparison in reproduction.comparisons]


def test_theorem_4_of_hu_and_yau_gives_the_converged_density(tmp_path):
    reproduction = studies.reproduce("hu-yau-2002", tmp_path, forms=1, observations=3)
    assert verdicts(reproduction) == ["agrees"] * 4 + ["differs"] * 2
    assert (tmp_path / "density-1.png").exists() and (tmp_path / "density-1.pdf").exists()


def test_yau_yau_is_the_converged_solution_on_a_short_cubic_sensor(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cubic_sensor, "FILTERS", {"yau-yau": cubic_sensor.FILTERS["yau-yau"]})
    reproduction = studies.reproduce("cubic-sensor", tmp_path, paths=2, steps=120)
    rows = {row[0]: row for row in reproduction.tables[0].rows}
    assert abs(rows["yau-yau"][1] / rows["converged solution"][1] - 1) < 1e-3
    assert abs(rows["yau-yau"][6] / rows["converged solution"][6] - 1) < 1e-2
    assert capsys.readouterr().out.startswith(f"written: {tmp_path / 'first-path.png'}")


def test_an_ensemble_follows_lorenz_better_than_its_samples(tmp_path, monkeypatch):
    pytest.importorskip("cuthbert")
    name = "ensemble, 100 members"
    monkeypatch.setattr(lorenz_63_sakov_2012, "LEVELS", (0.0,))
    monkeypatch.setattr(lorenz_63_sakov_2012, "FILTERS", {name: lorenz_63_sakov_2012.FILTERS[name]})
    reproduction = studies.reproduce("lorenz-63-sakov-2012", tmp_path, observations=90, records=2)
    assert 0.3 < reproduction.comparisons[0].ours < 0.9 < np.sqrt(lorenz_63_sakov_2012.NOISE)
    assert (tmp_path / "errors.png").exists() and (tmp_path / "first-record.png").exists()


def test_the_log_likelihood_of_the_cell_model_is_near_that_of_particles(tmp_path):
    found = studies.reproduce("heng-doob", tmp_path, observations=3, particles=2000, repeats=20)
    assert verdicts(found).count("agrees") == 2
    assert all(abs(row[5]) < 4 * row[4] for row in found.tables[0].rows)
    assert (tmp_path / "log-likelihoods.png").exists()


def test_log_likelihoods_by_particles_vary_little_and_agree_with_the_density_on_a_grid(tmp_path):
    found = studies.reproduce("heng-controlled", tmp_path, states=4, observations=4, counts=15, particles=1000, repeats=4)
    lorenz, neuron = found.tables[0].rows
    assert lorenz[2] < 0.5 and neuron[2] < 0.3 and verdicts(found)[1] == "agrees"
    assert abs(neuron[1] - neuron[4]) < 0.3
    assert (tmp_path / "log-likelihoods.png").exists()


def test_particles_follow_lorenz_better_than_an_ensemble(tmp_path):
    found = studies.reproduce("lorenz-63-ramgraber-2022", tmp_path, observations=80, unused=30, particles=500)
    assert found.comparisons[-1].ours < 0.43
    assert (tmp_path / "errors.png").exists()


def test_tensor_trains_follow_tracks_more_closely_than_a_thousand_particles(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "SYSTEMS", {"radar": tracking.radar, "bearings": tracking.bearings})
    monkeypatch.setattr(tracking, "SIZES", (1000,))
    monkeypatch.setattr(tracking, "TOLERANCES", (2e-2,))
    found = studies.reproduce("tracking", tmp_path, observations=4, particles=40_000)
    errors = {row[:2]: row[4] for row in found.tables[0].rows}
    for name in tracking.SYSTEMS:
        assert errors[name, tracking.TRAIN] < 0.5 * errors[name, tracking.BOOTSTRAP]
    assert (tmp_path / "error-and-time.png").exists() and (tmp_path / "posterior.png").exists()


def test_blocks_give_the_posterior_of_the_bimodal_problem(tmp_path):
    found = studies.reproduce("al-jarrah-2024", tmp_path, largest=4, records=2, samples=400)
    assert "agrees" in verdicts(found)
    assert all(row[1] < 2 * row[3] < row[4] for row in found.tables[0].rows)
    assert (tmp_path / "discrepancies.png").exists()


def test_other_filters_run_on_the_cubic_sensor(monkeypatch):
    filters = {name: of for name, of in cubic_sensor.FILTERS.items() if name != "particle, 500"}
    monkeypatch.setattr(cubic_sensor, "FILTERS", filters)
    short = studies.reproduce("cubic-sensor", paths=2, steps=30)
    assert [row[0] for row in short.tables[0].rows] == [*filters, cubic_sensor.REFERENCE]
    assert all(row[5] == "0" for row in short.tables[0].rows)


def said(name, folder=None, **options):
    return {one.what: one.verdict for one in studies.reproduce(name, folder, **options).comparisons}


def test_the_methods_of_the_survey_keep_to_their_thresholds(tmp_path):
    survey = said("survey", tmp_path, methods=5)
    assert (tmp_path / "converged.png").exists() and (tmp_path / "distances.png").exists()
    assert survey["(3) Algorithm 3: error of the density"] == "agrees"
    assert survey["(2) Algorithms 1 and 2: error of the density"] == "agrees"


def test_the_filter_of_dong_chen_and_yau_has_the_observed_block():
    filtered = said("dong-chen-yau-2021", largest=1, paths=10, observations=1)
    assert filtered["Theorem 4.1 on a member of the class: error of E[x1], deviations"] == "agrees"


def test_theorem_6_of_yau_holds_with_its_correction():
    yau = said("yau-1993")
    assert yau["Theorem 6, corrected, f = tanh x: error of the density"] == "agrees"
    assert yau["(6) without the factor 1/2, f = -x: error of the mean, deviations"] == "agrees"
    assert yau["(6) as printed, f = -x: error of the mean, deviations"].startswith("differs")
