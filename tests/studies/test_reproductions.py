"""What all reproductions share, and those whose figures cost no compilation."""

from __future__ import annotations

import json

import numpy as np
import pytest

import zakai
from zakai import studies
from zakai.errors import InputError
from zakai.studies import _published as published
from zakai.studies import al_jarrah_2024, dong_chen_yau_2021, heng_doob, lorenz_63_sakov_2012, survey, yau_1993
from zakai.studies import cubic_sensor as cubic
from zakai.studies._reference_density import conditional_densities, crank_nicolson

PNG, PDF = b"\x89PNG", b"%PDF"


def verdicts(reproduction) -> dict[str, str]:
    return {comparison.what: comparison.verdict for comparison in reproduction.comparisons}


def test_a_figure_with_chance_agrees_within_three_standard_errors_of_the_difference():
    assert published.by_chance("a", 1.0, 1.29, 0.08, "of b", 0.06).verdict == "agrees, 2.9 standard errors apart"
    assert published.by_chance("a", 1.0, 1.31, 0.08, "of b", 0.06).verdict == "differs, 3.1 standard errors apart: of b"
    assert published.by_chance("a", 1.0, 1.0, None, "of b").verdict == "too few runs to say"
    assert published.by_chance("a", 8.0, 8.0, 0.0, "of b").verdict == "agrees"
    assert published.by_chance("a", 8.0, 7.0, 0.0, "of b").verdict == "differs: of b"


def test_a_reproduction_is_printed_and_stored(tmp_path, capsys):
    long = published.by_computation("rank", "2", "3", False, "of a " + 40 * "long ")
    rows = (published.by_chance("mean", 1.5, 1.4, 0.25, ""), long)
    table = published.Table("More", ("filter", "mean"), (("ours", 1.4), ("theirs", None)))
    one = published.Reproduction("Title", "Scope", rows, "as it is.", (table,), {"paths": np.int64(7)})
    text = one.text()
    assert "1.400 +- 0.250" in text and "Verdict (1 of 2 figures agree): as it is." in text
    assert max(map(len, text.splitlines())) <= published.WIDTH
    one.save(tmp_path)
    assert (tmp_path / "table.txt").read_text() == text + "\n"
    stored = json.loads((tmp_path / "figures.json").read_text())
    assert stored["paths"] == 7 and stored["comparisons"][0]["published"] == 1.5
    assert capsys.readouterr().out.count("written: ") == 2


def test_a_picture_is_written_when_it_is_drawn_and_not_at_all_without_a_folder(tmp_path, capsys):
    from zakai.studies._drawing import new_figure

    published.Pictures(tmp_path).add("one", lambda: new_figure(1.0, 1.0))
    assert (tmp_path / "one.png").read_bytes().startswith(PNG) and (tmp_path / "one.pdf").read_bytes().startswith(PDF)
    assert capsys.readouterr().out.splitlines() == [f"written: {tmp_path / 'one'}.{kind}" for kind in ("png", "pdf")]
    published.Pictures().add("two", lambda: pytest.fail("drawn without a folder"))


def test_wrong_names_options_and_folders_are_said(tmp_path):
    with pytest.raises(InputError, match="chen-luo-yau-2017, cubic-sensor, yau-1993, hu-yau-2002, survey, dong-chen-yau-2021"):
        studies.reproduce("chen-luo-yau-2018")
    with pytest.raises(InputError, match='cubic-sensor: there is no option "path"; there is: paths, steps, seed'):
        studies.reproduce("cubic-sensor", path=3)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="folder cannot be made"):
        studies.reproduce("survey", tmp_path / "file")
    wrong = {
        "chen-luo-yau-2017": {"settings": "all"}, "cubic-sensor": {"paths": 0}, "yau-1993": {"order": 9},
        "hu-yau-2002": {"forms": 2.5}, "survey": {"methods": 0}, "dong-chen-yau-2021": {"largest": True},
        "lorenz-63-sakov-2012": {"observations": 64}, "lorenz-63-ramgraber-2022": {"observations": 1},
        "heng-doob": {"observations": 1}, "heng-controlled": {"states": 3}, "al-jarrah-2024": {"largest": 11},
        "tracking": {"observations": 1},
    }  # fmt: skip
    assert tuple(wrong) == studies.names()
    for name, options in wrong.items():
        with pytest.raises(InputError, match=f"option {next(iter(options))}: "):
            studies.reproduce(name, **options)


def kalman_bucy(increments, step, slope, mean, variance, parts=40, frozen=False):
    """Means, variances, evidence of f = slope x, h = x, y linear between observations, or frozen; Runge and Kutta's formula."""

    def rate(m, P, evidence, z):
        return np.array([slope * m + P * (z - m), 2 * slope * P + 1 - P**2, z * m - (m**2 + P) / 2])

    state, found = np.array([mean, variance, 0.0]), []
    for increment in increments:
        z, d = 0.0 if frozen else increment / step, step / parts
        for _ in range(parts):
            k1 = rate(*state, z)
            k2 = rate(*(state + d / 2 * k1), z)
            k3 = rate(*(state + d / 2 * k2), z)
            state = state + d / 6 * (k1 + 2 * k2 + 2 * k3 + rate(*(state + d * k3), z))
        if frozen:
            state = state + np.array([state[1] * increment, 0.0, state[0] * increment + state[1] * increment**2 / 2])
        found.append(state)
    return np.array(found).T


@pytest.mark.parametrize("frozen", [False, True])
def test_the_converged_solution_is_the_kalman_bucy_filter_of_a_linear_system(frozen):
    increments = np.array([0.2, -0.3, 0.15, 0.4])
    means, variances, evidence = kalman_bucy(increments, 0.1, -0.5, 0.4, 0.5, frozen=frozen)

    def prior(x):
        return np.exp(-((x[..., 0] - 0.4) ** 2))

    times = 0.1 * np.arange(1, 5)
    solution = conditional_densities(
        lambda x: -0.5 * x, lambda x: x, np.eye(1), prior, times, increments[:, None], 9.0, 128, frozen=frozen
    )
    np.testing.assert_allclose(solution.means[:, 0], means, rtol=0, atol=1e-8)
    np.testing.assert_allclose(solution.deviations[:, 0] ** 2, variances, rtol=0, atol=1e-8)
    np.testing.assert_allclose(solution.evidence, evidence, rtol=0, atol=1e-8)


def test_many_paths_at_once_are_the_kalman_bucy_filter_of_a_linear_system():
    increments = np.array([0.2, -0.3, 0.15, 0.4])
    means, variances, _ = kalman_bucy(increments, 0.1, -0.5, 0.4, 0.5)
    fine = np.repeat(increments / 50, 50)
    found = crank_nicolson(
        lambda x: -0.5 * x, lambda x: x, lambda x: -((x - 0.4) ** 2), np.array([fine, -fine]), 0.002, np.arange(-8, 8, 0.02)
    )
    np.testing.assert_allclose(found[0][0, 49::50], means, rtol=0, atol=2e-4)
    np.testing.assert_allclose(found[1][0, 49::50], variances, rtol=0, atol=2e-4)


def test_two_states_with_noises_that_are_correlated_converge_to_the_kalman_bucy_filter():
    # x1 alone is observed; x2 = x1 / 2 + an independent Brownian motion.
    G, times, increments = np.array([[1.0, 0.5], [0.5, 0.75]]), np.array([0.1, 0.2]), np.array([[0.1], [-0.2]])

    def prior(x):
        return np.exp(-0.5 * (x[..., 0] ** 2 + (x[..., 1] - 0.5 * x[..., 0]) ** 2) / 0.4)

    found = conditional_densities(lambda x: 0.0 * x, lambda x: x[..., :1], G, prior, times, increments, 6.0, 48, 1e-9)
    means, variances, _ = kalman_bucy(increments[:, 0], 0.1, 0.0, 0.0, 0.4)
    np.testing.assert_allclose(found.means, np.stack([means, means / 2], axis=1), rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.deviations[:, 1] ** 2, variances / 4 + 0.4 + 0.5 * times, rtol=0, atol=1e-6)


def test_the_errors_of_the_cubic_sensor_are_told_with_the_failures():
    truth, rng = np.zeros((4, 50)), np.random.default_rng(0)
    scores = {}
    for name in (*cubic.FILTERS, cubic.REFERENCE):
        mean = rng.normal(size=truth.shape) * 0.4
        if name == "ekf":
            mean[2, 30:] = np.nan
        scores[name] = cubic.score(truth, cubic.Estimates(mean, np.full(truth.shape, 0.16)))
    reproduction = cubic.reproduction(scores, "", {"paths": 4, "steps": cubic.STEPS, "seed": 0})
    rows = {row[0]: row[1:] for row in reproduction.tables[0].rows}
    assert rows["ekf"][4] == "1" and rows["yau-yau"][4] == "0"
    assert rows["yau-yau"][0] == pytest.approx(0.4, abs=0.05) and rows["yau-yau"][5] == pytest.approx(1.0, abs=0.2)
    assert "differs" in verdicts(reproduction)["RMSE, ekf"] and "not run here" in verdicts(reproduction)["RMSE, YauYauAL 0.1.0"]
    short = cubic.reproduction(scores, "", {"paths": 4, "steps": 50, "seed": 0})
    assert "not comparable" in verdicts(short)["RMSE, ekf"]


def test_the_paths_of_lorenz_keep_to_the_attractor_and_their_errors_are_told():
    truth, samples = lorenz_63_sakov_2012.paths(np.random.default_rng(0), 2, 120)
    assert np.std(samples - truth) == pytest.approx(np.sqrt(2), rel=0.1) and 40 < truth[..., 2].max() < 50
    good = np.array([lorenz_63_sakov_2012.root_mean_square(truth, truth + c) for c in (9.0, 0.9, 0.3, 0.6, 0.8)])
    errors = {"extended Kalman": good * 2, "ensemble, 100 members": good}
    reproduction = lorenz_63_sakov_2012.reproduction(errors, {"observations": 120, "records": 2, "seed": 0})
    assert [row[1] for row in reproduction.tables[0].rows] == ["18.00", "9.00"]
    assert [comparison.what for comparison in reproduction.comparisons] == [f"{name}, q = 0.1" for name in errors]
    assert "is the known one" in reproduction.verdict


def test_the_survey_and_we_admit_the_same_methods_but_where_more_is_true():
    found = survey.admitted()
    assert [one.ours for one in found] == ["1 2 3 4", "- 2 3 4", "- - 3 4", "1 - 3 4"]
    assert [one.verdict.partition(":")[0] for one in found] == ["agrees", "agrees", "agrees", "differs"]


def test_the_algebras_of_dong_chen_and_yau_are_told_with_their_misprints(tmp_path, capsys):
    reproduction = studies.reproduce("dong-chen-yau-2021", tmp_path, largest=1, paths=40, observations=0)
    said = verdicts(reproduction)
    differing = {what for what, verdict in said.items() if verdict.startswith("differs")}
    assert differing == {
        "Examples: coefficient of x1^2 in eta", "(53), Example 3.4: r1'", "Example 3.4 with phi_3 of the text",
        "Wong's system with f_3 of the introduction", "Wong's system with gamma(x1, x2, x3)",
    }  # fmt: skip
    assert said["Example 3.5: entries of Omega (27) that are right"] == "agrees"
    assert (tmp_path / "explosion.png").exists() and "written: " in capsys.readouterr().out
    model = dong_chen_yau_2021.load_model("gallery:dong-chen-yau-3-4")
    omega = dong_chen_yau_2021.analyze(model).omega
    assert not dong_chen_yau_2021.matches(omega, (3, 2), "3*x2**2", model)


def test_the_theorems_of_yau_are_told_with_their_misprints(tmp_path, capsys):
    reproduction = studies.reproduce("yau-1993", tmp_path, order=1, terms=1, observations=0)
    differing = [what for what, verdict in verdicts(reproduction).items() if verdict.startswith("differs")]
    assert [what.partition(":")[0] for what in differing] == ["Theorem 6, first line", "(14) as printed", "Theorem 12"]
    assert (tmp_path / "kolmogorov-series.png").exists()
    stored = json.loads((tmp_path / "figures.json").read_text())
    assert stored["verdict"] == reproduction.verdict and len(stored["comparisons"]) == len(reproduction.comparisons)


def test_equation_6_of_theorem_6_has_a_factor_one_half_too_much():
    times, increments = 0.1 * np.arange(1, 5), np.array([0.2, -0.3, 0.15, 0.4])
    means = kalman_bucy(increments, 0.1, -1.0, 1.0, 0.5)[0]
    np.testing.assert_allclose(yau_1993.statistics_mean(times, increments, 1.0, 0.5, 1.0), means, rtol=0, atol=1e-8)
    assert np.abs(yau_1993.statistics_mean(times, increments, 1.0, 0.5, 0.5) - means).max() > 1e-3


def test_the_bootstrap_filter_of_the_cell_model_gives_the_evidence_of_one_observation():
    """Without noise every particle follows the solution of the differential equation from near the start."""
    short = heng_doob.bootstrap(zakai.Record([1.0], np.array([[1.2, 1.1]]), "samples"), 1e-12, 4, 3, 1)
    path = np.array([1.0, 1.0])
    for _ in range(50):
        power = path**4
        path = path + heng_doob.EULER * (power / (0.0625 + power) + 0.0625 / (0.0625 + power[::-1]) - path)
    expected = -0.5 * np.sum((np.array([1.2, 1.1]) - path) ** 2) / heng_doob.NOISE**2 - np.log(2 * np.pi * heng_doob.NOISE**2)
    assert np.allclose(short, expected, atol=0.2)


def test_the_discrepancy_of_two_shifted_gaussians_is_that_of_the_formula():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((4000, 2)), rng.standard_normal((4000, 2)) + [2.0, 0.0]
    width = al_jarrah_2024.WIDTH / 2  # exp(-d^2 / 2 width); the difference of two draws has variance 2
    factor = width / (width + 2)
    expected = np.sqrt(2 * factor * (1 - np.exp(-0.5 * 4.0 / (width + 2))))
    assert al_jarrah_2024.discrepancy(a, b) == pytest.approx(expected, rel=0.05)


def test_the_posterior_of_the_bimodal_problem_is_symmetric_and_has_two_modes():
    weights = al_jarrah_2024.posterior(np.array([[1.0, 0.0]] * 3))
    assert np.allclose(weights, weights[::-1]) and np.allclose(weights.sum(axis=0), 1.0)
    assert abs(abs(al_jarrah_2024.AXIS[np.argmax(weights[:, 0])]) - 1.0) < 0.05
    assert weights[600, 0] < 0.05 * weights[:, 0].max() and weights[600, 1] > 0.9 * weights[:, 1].max()
    draws = al_jarrah_2024.drawn(weights, 2000, np.random.default_rng(1))
    assert abs(np.mean(draws[:, 0] > 0) - 0.5) < 0.05
