"""The reproductions that filter, run in small: what they compile takes seconds."""

from __future__ import annotations

import numpy as np
import pytest

from zakai import studies
from zakai.studies import cubic_sensor, lorenz_63_sakov_2012


def verdicts(reproduction) -> list[str]:
    return [comparison.verdict.partition(",")[0].partition(":")[0] for comparison in reproduction.comparisons]


@pytest.mark.slow
def test_theorem_4_of_hu_and_yau_and_the_survey_s_theorem_1_are_the_converged_density(tmp_path):
    told = studies.reproduce("hu-yau-2002", tmp_path, systems=1, forms=1, readings=3)
    assert verdicts(told) == ["agrees", "differs", "differs"]
    told = studies.reproduce("survey", tmp_path, methods=1, readings=3)
    assert verdicts(told) == ["agrees", "agrees", "agrees", "differs", "agrees"]
    for name in ("density-1", "converged", "distances"):
        assert (tmp_path / f"{name}.png").exists() and (tmp_path / f"{name}.pdf").exists()


@pytest.mark.slow
def test_yau_yau_is_the_converged_solution_on_a_short_cubic_sensor(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cubic_sensor, "FILTERS", {"yau-yau": cubic_sensor.FILTERS["yau-yau"]})
    told = studies.reproduce("cubic-sensor", tmp_path, paths=2, steps=120)
    rows = {row[0]: row for row in told.tables[0].rows}
    assert abs(rows["yau-yau"][1] / rows["converged solution"][1] - 1) < 1e-3
    assert abs(rows["yau-yau"][6] / rows["converged solution"][6] - 1) < 1e-2
    assert capsys.readouterr().out.startswith(f"written: {tmp_path / 'first-path.png'}")


@pytest.mark.slow
def test_an_ensemble_follows_lorenz_better_than_its_readings(tmp_path, monkeypatch):
    pytest.importorskip("cuthbert")
    name = "ensemble, 100 members"
    monkeypatch.setattr(lorenz_63_sakov_2012, "FILTERS", {name: lorenz_63_sakov_2012.FILTERS[name]})
    told = studies.reproduce("lorenz-63-sakov-2012", tmp_path, observations=90, records=2)
    assert 0.3 < told.comparisons[0].ours < 0.9 < np.sqrt(lorenz_63_sakov_2012.NOISE)
    assert (tmp_path / "errors.png").exists() and (tmp_path / "first-record.png").exists()


@pytest.mark.slow
@pytest.mark.longest
def test_every_filter_and_theorem_that_is_left():
    short = studies.reproduce("cubic-sensor", paths=2, steps=400)
    assert [row[0] for row in short.tables[0].rows] == [*cubic_sensor.FILTERS, cubic_sensor.REFERENCE]
    assert all(row[5] == "0" for row in short.tables[0].rows)
    assert set(verdicts(studies.reproduce("hu-yau-2002"))[:-2]) == {"agrees"}
    by_what = {one.what: one.verdict for one in studies.reproduce("survey").comparisons}
    assert by_what["(3) Algorithm 3, power series: error of the density"] == "agrees"
    assert by_what["(4) Algorithm 4: error of the density"] == "agrees"
    by_what = {one.what: one.verdict for one in studies.reproduce("dong-chen-yau-2021", largest=1, paths=10).comparisons}
    assert by_what["Theorem 4.1 on a member of the class: error of E[x1], deviations"] == "agrees"
    by_what = {one.what: one.verdict for one in studies.reproduce("yau-1993").comparisons}
    assert by_what["Theorem 6, corrected, f = tanh x: error of the density"] == "agrees"
    assert by_what["(6) without the factor 1/2, f = -x: error of the mean, deviations"] == "agrees"
    assert by_what["(6) as printed, f = -x: error of the mean, deviations"].startswith("differs")
