"""Every figure of a study against a plain reference: closed forms, SciPy, and integrals by brute force."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.linalg import expm

import zakai
from zakai.densities.gaussian import GaussianMixture
from zakai.studies import metrics
from zakai.studies.innovations import Innovations

LINE, CIRCLE = (False,), (True,)


def random_moments(rng, count, n):
    roots = rng.normal(size=(count, n, n))
    return rng.normal(size=(count, n)), roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(n)


def wrapped_normal(deviation, spread):
    """The density of an angle by its sum over windings."""
    return sum(stats.norm.pdf(deviation + 2 * np.pi * k, scale=spread) for k in range(-12, 13))


def test_errors_of_angles_are_the_short_way_round():
    truth, mean = np.array([[3.0, 3.0], [-1.0, 0.5]]), np.array([[-3.0, -3.0], [1.0, 0.25]])
    short = 2 * np.pi - 6
    assert metrics.deviations(truth, mean, (True, False)) == pytest.approx(np.array([[-short, 6.0], [-2.0, 0.25]]))
    assert metrics.squared_error(truth, mean, (True, False)) == pytest.approx([short**2 + 36, 4.0625])
    assert metrics.distance(truth, mean, (True, False)) == pytest.approx(np.sqrt((short**2 + 36 + 4.0625) / 2))


def test_nees_is_the_form_of_the_inverse():
    rng = np.random.default_rng(1)
    for n in (1, 3):
        mean, cov = random_moments(rng, 7, n)
        truth = rng.normal(size=(7, n))
        expected = [(x - m) @ np.linalg.inv(P) @ (x - m) for x, m, P in zip(truth, mean, cov)]
        assert metrics.nees(truth, mean, cov, (False,) * n) == pytest.approx(expected, rel=1e-9)


def test_nees_of_a_singular_covariance_counts_what_it_allows():
    cov = np.array([[[4.0, 0.0], [0.0, 0.0]]] * 2)
    value = metrics.nees(np.array([[2.0, 0.0], [2.0, 1.0]]), np.zeros((2, 2)), cov, LINE * 2)
    assert value.tolist() == [1.0, np.inf]
    none = metrics.nees(np.ones((2, 1)), np.zeros((2, 1)), np.array([[[0.0]], [[-1.0]]]), LINE)
    assert none.tolist() == [np.inf] * 2
    assert np.isnan(metrics.nees(np.array([[np.nan, 0.0]]), np.zeros((1, 2)), cov[:1], LINE * 2)).all()


def test_chi_square_bounds_are_those_of_the_textbooks_table():
    # 100 degrees: 74.222 and 129.561, 50 runs of two states.
    assert metrics.chi_square_bounds(2, 50) == pytest.approx((74.222 / 50, 129.561 / 50), rel=1e-5)
    assert metrics.chi_square_bounds(1) == pytest.approx((0.000982, 5.0239), rel=1e-3)


@pytest.mark.parametrize("truth, mean, variance", [(0.3, 1.0, 0.5), (-4.0, 1.0, 0.04), (2.0, 2.0, 9.0)])
def test_crps_of_a_gaussian_is_the_integral(truth, mean, variance):
    spread = np.sqrt(variance)
    below, _ = integrate.quad(lambda y: stats.norm.cdf(y, mean, spread) ** 2, -60, truth, limit=400, points=[mean])
    above, _ = integrate.quad(lambda y: stats.norm.sf(y, mean, spread) ** 2, truth, 60, limit=400, points=[mean])
    value = metrics.crps_gaussian(np.array([[truth]]), np.array([[mean]]), np.array([[variance]]), LINE)
    assert value == pytest.approx(below + above, abs=1e-7)


@pytest.mark.parametrize("spread", [0.02, 0.2, 0.499, 0.501, 1.0, 3.0])
@pytest.mark.parametrize("deviation", [0.0, 0.7, -3.1])
def test_crps_of_an_angle_is_the_double_integral_over_arcs(deviation, spread):
    points = np.arange(-6000, 6000) * np.pi / 6000
    weights = wrapped_normal(points, spread)
    weights /= weights.sum()
    arcs = np.abs(np.angle(np.exp(1j * points)))
    spectrum = np.fft.fft(weights)
    between = np.real(np.fft.ifft(spectrum * spectrum.conj()))  # the law of X - X', whose lag 0 stands first
    lag = np.minimum(np.arange(12000), 12000 - np.arange(12000)) * np.pi / 6000
    to_truth = np.abs(np.angle(np.exp(1j * (points - deviation))))
    expected = weights @ to_truth - 0.5 * between @ lag
    mean = 3.0  # so that the truth lies beyond pi
    value = metrics.crps_gaussian(np.array([[mean + deviation]]), np.array([[mean]]), np.array([[spread**2]]), CIRCLE)
    assert arcs.max() <= np.pi and value == pytest.approx(expected, abs=1e-6)


def test_crps_of_points_is_the_mean_of_all_pairs():
    rng = np.random.default_rng(2)
    sample, truth = rng.uniform(-3.1, 3.1, size=(3, 20, 2)), rng.uniform(-3, 3, size=(3, 2))
    value = metrics.crps_sample(truth, sample, (False, True))
    for run in range(3):
        for state, way in ((0, abs), (1, lambda d: abs(np.angle(np.exp(1j * d))))):
            column = sample[run, :, state]
            first = np.mean([way(a - truth[run, state]) for a in column])
            second = np.mean([way(a - b) for a in column for b in column])
            assert value[run, state] == pytest.approx(first - second / 2, abs=1e-12)


def test_pit_is_the_distribution_function_and_begins_opposite_the_mean_for_an_angle():
    truth, mean, variance = np.array([[0.4, -3.0]]), np.array([[1.0, 3.0]]), np.array([[0.25, 1.44]])
    deviation = 2 * np.pi - 6
    expected = integrate.quad(lambda d: wrapped_normal(d, 1.2), -np.pi, deviation)[0]
    value = metrics.pit_gaussian(truth, mean, variance, (False, True))
    assert value[0] == pytest.approx([stats.norm.cdf(0.4, 1.0, 0.5), expected], abs=1e-9)
    quantiles = stats.norm.ppf(metrics.PROBABILITIES)[:, None] * [0.5, 0.3] + [1.0, 3.0]
    quantiles[:, 1] = np.sort(np.angle(np.exp(1j * quantiles[:, 1])))
    value = metrics.pit_sample(truth[0], mean[0], quantiles, (False, True))
    assert value == pytest.approx([stats.norm.cdf(0.4, 1.0, 0.5), stats.norm.cdf(deviation / 0.3)], abs=1e-4)


def test_uniformity_is_the_largest_gap_of_the_staircase_and_finds_what_is_not_uniform():
    values = np.array([0.1, 0.4, np.nan, 0.45, 0.9])
    stair = max(max(abs(k / 4 - u), abs((k + 1) / 4 - u)) for k, u in enumerate([0.1, 0.4, 0.45, 0.9]))
    assert metrics.uniformity(values)[0] == pytest.approx(stair)
    rng = np.random.default_rng(3)
    assert metrics.uniformity(rng.uniform(size=2000))[1] > 0.01
    assert metrics.uniformity(rng.uniform(size=2000) ** 1.2)[1] < 1e-4
    assert np.isnan(metrics.uniformity(np.array([np.nan]))).all()


def test_log_score_is_scipys_density_and_the_sum_over_windings_for_an_angle():
    rng = np.random.default_rng(4)
    mean, cov = random_moments(rng, 5, 2)
    truth = rng.normal(size=(5, 2))
    expected = [-stats.multivariate_normal.logpdf(x, m, P) for x, m, P in zip(truth, mean, cov)]
    assert metrics.log_score_gaussian(truth, mean, cov, LINE * 2) == pytest.approx(expected)
    value = metrics.log_score_gaussian(np.array([-3.0]), np.array([3.0]), np.array([[1.5**2]]), CIRCLE)
    assert value == pytest.approx(-np.log(wrapped_normal(2 * np.pi - 6, 1.5)), abs=1e-6)
    assert metrics.log_score_gaussian(np.zeros(2), np.zeros(2), np.diag([1.0, 0.0]), LINE * 2) == np.inf


def test_hellinger_of_gaussians_is_the_integral():
    m, s, other, r = 0.2, 0.7, 1.5, 1.9
    inside, _ = integrate.quad(lambda x: np.sqrt(stats.norm.pdf(x, m, s) * stats.norm.pdf(x, other, r)), -20, 20)
    one, two = (np.array([m]), np.array([[s * s]])), (np.array([other]), np.array([[r * r]]))
    closed = metrics.hellinger_gaussian(*one, *two, LINE)
    assert closed == pytest.approx(np.sqrt(1 - inside), abs=1e-9)
    same = metrics.hellinger_gaussian(np.zeros(1), np.eye(1), np.zeros(1), np.eye(1), LINE)
    far = metrics.hellinger_gaussian(np.zeros(1), np.eye(1), np.full(1, 90.0), np.eye(1), LINE)
    assert (float(same), float(far)) == (0.0, 1.0)


def gaussian(mean, cov, periodic):
    names = tuple(f"x{i}" for i in range(len(mean)))
    return GaussianMixture(np.ones(1), np.array([mean], float), np.array([cov], float), names, periodic)


def test_hellinger_of_densities_is_that_of_gaussians_where_they_are():
    one, two = gaussian([0.2], [[0.49]], LINE), gaussian([1.5], [[3.61]], LINE)
    closed = metrics.hellinger_gaussian(np.array([0.2]), np.array([[0.49]]), np.array([1.5]), np.array([[3.61]]), LINE)
    assert metrics.hellinger(one, two) == pytest.approx(float(closed), abs=1e-5)
    assert metrics.hellinger(one, one) < 1e-3
    narrow = gaussian([40.0], [[1e-8]], LINE)
    assert metrics.hellinger(one, narrow) == pytest.approx(1.0, abs=1e-6)
    cov, other = np.array([[1.0, 0.5], [0.5, 2.0]]), np.diag([1.5, 1.0])
    closed = metrics.hellinger_gaussian(np.zeros(2), cov, np.array([0.5, 0.2]), other, LINE * 2)
    drawn = metrics.hellinger(gaussian([0, 0], cov, LINE * 2), gaussian([0.5, 0.2], other, LINE * 2))
    assert drawn == pytest.approx(float(closed), rel=0.03)


def test_hellinger_of_angles_is_the_integral_over_the_circle():
    points = np.linspace(-np.pi, np.pi, 20001)
    p, q = wrapped_normal(points - 2.9, 0.5), wrapped_normal(points + 3.0, 1.4)
    expected = np.sqrt(1 - np.trapezoid(np.sqrt(p * q), points))
    one, two = gaussian([2.9], [[0.25]], CIRCLE), gaussian([-3.0], [[1.96]], CIRCLE)
    assert metrics.hellinger(one, two) == pytest.approx(expected, abs=1e-4)


def test_scores_of_a_density_are_those_of_its_shape():
    truth = np.array([0.7])
    single = gaussian([0.2], [[0.49]], LINE)
    crps, pit, score = metrics.density_scores(single, truth)
    assert crps == pytest.approx(metrics.crps_gaussian(truth, np.array([0.2]), np.array([0.49]), LINE), abs=1e-4)
    assert pit == pytest.approx(stats.norm.cdf(0.5 / 0.7), abs=1e-4)
    assert score == pytest.approx(-stats.norm.logpdf(0.7, 0.2, 0.7))
    two = GaussianMixture(np.array([0.3, 0.7]), np.array([[-2.0], [2.0]]), np.full((2, 1, 1), 0.04), ("x",), LINE)
    cdf = lambda y: 0.3 * stats.norm.cdf(y, -2, 0.2) + 0.7 * stats.norm.cdf(y, 2, 0.2)  # noqa: E731
    grid = np.linspace(-4, 4, 80001)
    expected = np.trapezoid((cdf(grid) - (grid >= 0.7)) ** 2, grid)
    assert metrics.density_scores(two, truth)[0] == pytest.approx(expected, rel=2e-3)


def test_over_runs_counts_failures_and_leaves_them_out():
    said = metrics.over_runs(np.array([1.0, 4.0, np.nan, 2.0, 1e9]), np.array([False, False, False, False, True]))
    assert said == {
        "mean": pytest.approx(7 / 3), "standard_error": pytest.approx(np.std([1, 4, 2], ddof=1) / np.sqrt(3)),
        "median": 2.0, "worst": 4.0, "runs": 3, "failures": 2,
    }  # fmt: skip
    assert metrics.over_runs(np.array([np.inf]), np.array([False]))["mean"] is None


LINEAR = {
    "state": ["x", "v"], "drift": ["v", "-2*x - 0.3*v"], "observation": ["x", "x + v"],
    "diffusion": [["0"], ["1.2"]], "observation_noise": [["0.5", "0.1"], ["0.1", "0.3"]],
    "prior": {"kind": "gaussian", "mean": [0.3, -0.2], "cov": [[1.0, 0.0], [0.0, 0.5]]},
}  # fmt: skip
TIMES = np.array([0.1, 0.3, 0.35, 0.9, 1.3])


def test_innovations_of_increments_are_those_of_the_matrix_exponential():
    """Van Loan's integrals of the linear system with what is observed beside the state."""
    model = zakai.Model(**LINEAR)
    rng = np.random.default_rng(5)
    mean, cov = random_moments(rng, 6, 2)
    values = rng.normal(size=(5, 2))
    found, spread = Innovations(model)(zakai.Record(TIMES, values, "increments"), mean, cov)
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, :2] = [[0, 1], [-2, -0.3]], [[1, 0], [1, 1]]
    noise = np.zeros((4, 4))
    noise[1, 1], noise[2:, 2:] = 1.44, [[0.5, 0.1], [0.1, 0.3]]
    for k, dt in enumerate(np.diff(np.concatenate([[0.0], TIMES]))):
        block = expm(np.block([[-A, noise], [np.zeros((4, 4)), A.T]]) * dt)
        move = block[4:, 4:].T
        start = np.zeros((4, 4))
        start[:2, :2] = cov[k]
        end = move @ start @ move.T + move @ block[:4, 4:]
        assert found[k] == pytest.approx(values[k] - (move @ np.concatenate([mean[k], [0, 0]]))[2:], abs=1e-6)
        assert spread[k] == pytest.approx(end[2:, 2:], abs=1e-5)


def test_innovations_of_samples_give_the_log_likelihood_of_the_kalman_filter():
    model = zakai.Model(**LINEAR, observation_kind="samples")
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 31), seed=3)
    values = record.values.copy()
    values[4, 0] = values[9] = np.nan
    record = zakai.Record(record.times, values, "samples")
    result = zakai.filter(model, record, "kalman-bucy")
    found, spread = Innovations(model)(record, result.mean, result.cov)
    for k in range(30):
        seen = ~np.isnan(values[k])
        part = spread[k][np.ix_(seen, seen)]
        expected = stats.multivariate_normal.logpdf(found[k][seen], cov=part) if seen.any() else 0.0
        assert result.log_likelihood_increments[k + 1] == pytest.approx(expected, abs=1e-5)
    nis, degrees = Innovations(model).nis(record, result.mean, result.cov)
    assert degrees.tolist() == [(~np.isnan(row)).sum() for row in values]
    assert np.isnan(nis[9]) and nis[4] == pytest.approx(found[4, 1] ** 2 / spread[4, 1, 1])


def test_nees_and_nis_of_the_right_filter_keep_to_their_bounds_and_of_a_wrong_one_do_not():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    runs = [zakai.simulate(model, 0.1 * np.arange(1, 41), seed=s) for s in range(30)]
    results = zakai.filter(model, [record for _, record in runs], "kalman-bucy")
    truth, mean, cov = (np.stack(a) for a in zip(*((t.values, r.mean, r.cov) for (t, _), r in zip(runs, results))))
    low, high = metrics.chi_square_bounds(1, 30, 0.9999)
    right = metrics.nees(truth, mean, cov, LINE).mean(axis=0)
    assert ((low < right) & (right < high)).all()
    assert (metrics.nees(truth, mean, 0.2 * cov, LINE).mean(axis=0) > high).mean() > 0.5
    innovations = Innovations(model)
    nis = np.stack([innovations.nis(record, r.mean, r.cov)[0] for (_, record), r in zip(runs, results)])
    low, high = metrics.chi_square_bounds(1, nis.size, 0.999)
    assert low < nis.mean() < high


def test_an_increment_over_a_gap_has_no_innovation():
    model = zakai.Model(**LINEAR, observation_kind="path")
    values = np.array([[0.1, 0.2], [np.nan, 0.3], [0.2, 0.1], [0.5, 0.5], [0.1, 0.2]])
    result = SimpleNamespace(mean=np.zeros((6, 2)), cov=np.tile(np.eye(2), (6, 1, 1)))
    _, degrees = Innovations(model).nis(zakai.Record(TIMES, values, "path"), result.mean, result.cov)
    assert degrees.tolist() == [2, 1, 1, 2, 2]
