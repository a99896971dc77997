"""The experiment of Chen, Luo and Yau: its reference is right, and the direct method keeps to it."""

import json

import numpy as np
import pytest

import zakai
from zakai import studies
from zakai.studies import chen_luo_yau_2017 as study_module
from zakai.studies._grid_optimal import grid_optimal

NAME = "chen-luo-yau-2017"
SETTINGS = (study_module.Setting("standard deviation", 3.0),)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "new" / "folder"
    seen = []
    study = studies.reproduce(NAME, folder, lambda done, total: seen.append((done, total)), paths=2, steps=120, settings=SETTINGS)
    return study, folder, seen


def assert_bands(study):
    for setting in study.figures["settings"]:
        assert abs(setting["direct_over_grid_percent"]) <= 0.5, setting
        assert setting["rms_difference_of_means"] <= 0.02, setting


def test_the_grid_is_the_kalman_filter_for_a_linear_system():
    step, steps, slope, gain = 0.02, 40, -0.4, 1.3
    rng = np.random.default_rng(3)
    increments = step * rng.normal(size=(2, steps, 1)) + np.sqrt(step) * rng.normal(size=(2, steps, 1))
    starts, variances = np.array([[0.5, -1.0], [0.2, 2.0]]), np.array([0.3, 2.0])
    means = grid_optimal(lambda x, t: slope * x, lambda x: gain * x[:, None], increments, step, starts, variances, 14.0)
    for setting, variance in enumerate(variances):
        for path in range(2):
            mean, cov = starts[setting, path], variance
            for k in range(steps):
                total = (gain * step) ** 2 * cov + step
                mean, cov = (
                    mean + cov * gain * step / total * (increments[path, k, 0] - gain * step * mean),
                    cov - (cov * gain * step) ** 2 / total,
                )
                mean, cov = (1 + slope * step) * mean, (1 + slope * step) ** 2 * cov + step
                assert means[setting, path, k + 1] == pytest.approx(mean, abs=1e-10)


def test_the_direct_method_keeps_to_the_grid_on_a_few_short_paths(small):
    assert_bands(small[0])


def test_the_filters_run_at_once_are_those_of_the_driver(small):
    study = small[0]
    _, increments = study_module.euler_paths(np.random.default_rng(study.figures["seed"]), 2, 120)
    record = zakai.Record(study.times[1:], increments[1], "increments")
    number = 0
    keys = {"state": ["x"], "drift": ["t/40 * x"], "observation": ["x*sin(x)", "x*cos(x)"], "observation_kind": "increments"}
    first = float(study.means["direct"][number, 1, 0])
    model = zakai.Model(**keys, prior={"kind": "gaussian", "mean": [first], "cov": [[study.settings[number].spread]]})
    for name, riccati in (("ekf-euler", "euler"), ("ekf-stable", "stable")):
        alone = zakai.filter(model, record, method="extended-kalman-bucy", riccati=riccati)
        np.testing.assert_allclose(study.means[name][number, 1], alone.mean[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(study.means["direct"][number, 1], zakai.filter(model, record).mean[:, 0], rtol=0, atol=1e-12)


def test_euler_loses_the_paths_that_the_criterion_names():
    # A first estimate beyond sqrt(1 / (P0 dt) - 1): 5.7 for P0 = 3, 3 for P0 = 10, and the counts that the paper gives.
    standard = [study_module.Setting("standard deviation", p).expected_losses for p in study_module.PAPER]
    variance = [study_module.Setting("variance", p).expected_losses for p in study_module.PAPER]
    np.testing.assert_allclose(standard, [0, 0.059, 0.764], atol=1e-3)
    np.testing.assert_allclose(variance, [0, 0.001, 0.343], atol=1e-3)


def test_the_table_and_the_pictures_are_in_the_folder(small, capsys):
    study, folder, seen = small
    text = study.text()
    assert "2.1196" in text and "lost of 2" in text and "not: the absolute errors" in text
    assert (folder / "table.txt").read_text() == text + "\n"
    assert "standard errors apart" in text
    stored = json.loads((folder / "figures.json").read_text())
    assert stored == study.figures and stored["settings"][0]["mse"]["direct"] > 0
    for number in (2,):
        assert (folder / f"figure-{number}.png").read_bytes().startswith(b"\x89PNG")
        assert (folder / f"figure-{number}.pdf").read_bytes().startswith(b"%PDF")
    assert seen[-1][0] == seen[-1][1] and [done for done, _ in seen] == list(range(1, len(seen) + 1))


def test_the_direct_method_is_optimal_and_the_ekf_far_from_it_on_whole_paths():
    # Of the six columns the narrowest and the widest: euler loses no path of the first and 76 of 100 of the second.
    narrow, wide = study_module.Setting("variance", 0.1), study_module.Setting("standard deviation", 10.0)
    study = study_module.run(paths=8, settings=(narrow, wide))
    assert_bands(study)
    first, last = study.figures["settings"]
    assert first["mse"]["ekf-stable"] > 2 * first["mse"]["direct"]
    assert first["lost"] == 0 and last["lost"] >= 4
