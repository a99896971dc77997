"""The extended Kalman-Bucy filter against the integrated Riccati equation, the Kalman filter and the blow-up criterion."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import zakai
from zakai.algebra.choice import recommended
from zakai.errors import InputError

METHOD = "extended-kalman-bucy"


def model(**keys):
    """A stable linear system in two coordinates with two observations, changed by `keys`."""
    plain = {
        "state": ["x", "v"],
        "drift": ["v", "-2*x - v/2"],
        "process_noise": [["0.3", "0.1"], ["0.1", "0.5"]],
        "observation": ["x", "x + 2*v"],
        "observation_noise": [["0.4", "0.1"], ["0.1", "0.3"]],
        "observation_kind": "increments",
        "prior": {"kind": "gaussian", "mean": [1.0, -0.5], "cov": [[0.8, 0.1], [0.1, 0.6]]},
    }
    return zakai.Model(**{**plain, **keys})


def spiral(mean, variance):
    return zakai.Model(
        state=["x"],
        drift=["t/40 * x"],
        observation=["x*sin(x)", "x*cos(x)"],
        observation_kind="increments",
        prior={"kind": "gaussian", "mean": [mean], "cov": [[variance]]},
    )


def run(system, record, **options):
    return zakai.filter(system, record, method=METHOD, **options)


def at_zero(system):
    return dict.fromkeys(system.x, 0) | dict(zip(system.parameter_symbols, system.theta()))


def numbers(system):
    """A, G, H, S, and the prior of a linear model, by evaluating its formulas."""
    zero = at_zero(system)
    A = np.array(system.drift.jacobian(system.x).subs(zero), float)
    H = np.array(system.observation.jacobian(system.x).subs(zero), float)
    G, S = np.array(system.covariance, float), np.array(system.observation_noise, float)
    return A, G, H, S, system.prior.mean, system.prior.cov


def kalman_bucy(system, increments, step):
    """The Kalman-Bucy equations with y linear between observations, by an adaptive integrator: mean, cov and log-evidence."""
    A, G, H, S, mean, cov = numbers(system)
    n, evidence = len(mean), 0.0
    weigh, constant = H.T @ np.linalg.inv(S), np.array(system.drift.subs(at_zero(system)), float)[:, 0]
    for rate in increments / step:

        def slope(_, z, rate=rate):
            m, P = z[:n], z[n : n + n * n].reshape(n, n)
            h = H @ m
            dm = A @ m + constant + P @ weigh @ (rate - h)
            dP = A @ P + P @ A.T + G - P @ weigh @ H @ P
            # d log p = E[h]'S^-1 dy - E[h'S^-1 h] dt / 2 along a path of bounded variation
            dl = h @ np.linalg.solve(S, rate) - 0.5 * h @ np.linalg.solve(S, h) - 0.5 * np.trace(weigh @ H @ P)
            return np.concatenate([dm, dP.ravel(), [dl]])

        end = solve_ivp(slope, (0, step), np.concatenate([mean, cov.ravel(), [0.0]]), rtol=1e-10, atol=1e-12).y[:, -1]
        mean, cov, evidence = end[:n], end[n:-1].reshape(n, n), evidence + end[-1]
    return mean, cov, evidence


@pytest.fixture(scope="module")
def increments():
    return np.random.default_rng(0).normal(size=(10, 2)) * [0.3, 0.25] + [0.1, 0.05]


@pytest.mark.parametrize(("riccati", "order"), [("stable", 2), ("euler", 1)])
def test_the_step_has_its_order_against_the_integrated_riccati_equation(increments, riccati, order):
    mean, cov, evidence = kalman_bucy(model(), increments, 0.2)
    record = zakai.Record(0.2 * np.arange(1, 11), increments, "increments")
    errors = []
    for substeps in (4, 8, 16):
        result = run(model(), record, riccati=riccati, substeps=substeps)
        miss = [abs(result.mean[-1] - mean).max(), abs(result.cov[-1] - cov).max(), abs(result.log_likelihood - evidence)]
        errors.append(miss)
    measured = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(abs(measured[-1] - order) < 0.2), measured
    assert errors[-1][0] < (2e-4 if order == 2 else 2e-2)


def test_samples_of_a_linear_system_give_the_kalman_filter_also_at_the_start_and_with_gaps():
    system = model(observation_kind="samples")
    A, G, H, S, mean, cov = numbers(system)
    times = np.array([0.0, 0.3, 0.35, 1.4, 2.0])
    values = np.random.default_rng(1).normal(size=(5, 2))
    values[1, 0] = values[3, 1] = np.nan
    values[2] = np.nan
    result = run(system, zakai.Record(times, values, "samples"))
    before = 0.0
    for k, (time, z) in enumerate(zip(times, values)):
        block = expm((time - before) * np.block([[-A, G], [np.zeros((2, 2)), A.T]]))
        transition = block[2:, 2:].T
        mean, cov = transition @ mean, transition @ cov @ transition.T + transition @ block[:2, 2:]
        seen = ~np.isnan(z)
        evidence = 0.0
        if seen.any():
            C, R = H[seen], S[np.ix_(seen, seen)]
            total = C @ cov @ C.T + R
            residual = z[seen] - C @ mean
            evidence = -0.5 * residual @ np.linalg.solve(total, residual) - 0.5 * np.linalg.slogdet(2 * np.pi * total)[1]
            gain = cov @ C.T @ np.linalg.inv(total)
            mean, cov = mean + gain @ residual, cov - gain @ C @ cov
        np.testing.assert_allclose(result.mean[k + 1], mean, rtol=0, atol=2e-12)
        np.testing.assert_allclose(result.cov[k + 1], cov, rtol=0, atol=2e-12)
        assert result.log_likelihood_increments[k + 1] == pytest.approx(evidence, abs=2e-12)
        before = time


@pytest.mark.parametrize("riccati", ["stable", "euler"])
def test_a_coordinate_that_is_never_observed_is_the_same_as_a_sensor_that_is_not_there(increments, riccati):
    times = np.cumsum([0.05, 0.01, 0.2, 0.03, 0.1, 0.05, 0.02, 0.07, 0.1, 0.02])
    one = model(observation=["x"], observation_noise=[["0.4"]])
    half = np.where([True, False], increments, np.nan)
    both = run(model(), zakai.Record(times, half, "increments"), riccati=riccati)
    alone = run(one, zakai.Record(times, increments[:, :1], "increments"), riccati=riccati)
    np.testing.assert_allclose(both.mean, alone.mean, rtol=0, atol=1e-13)
    np.testing.assert_allclose(both.cov, alone.cov, rtol=0, atol=1e-13)
    np.testing.assert_allclose(both.log_likelihood_increments, alone.log_likelihood_increments, rtol=0, atol=1e-12)


def test_a_row_without_any_reading_is_a_prediction_with_no_evidence(increments):
    record = zakai.Record([0.5], [[np.nan, np.nan]], "increments")
    A, _, _, _, mean, cov = numbers(model())
    result = run(model(), record)
    np.testing.assert_allclose(result.mean[-1], expm(0.5 * A) @ mean, rtol=0, atol=1e-12)
    assert np.linalg.det(result.cov[-1]) > np.linalg.det(cov)
    assert result.log_likelihood == 0.0


def test_increments_rates_and_path_tell_the_same(increments):
    times = np.cumsum([0.05, 0.01, 0.2, 0.03, 0.1, 0.05, 0.02, 0.07, 0.1, 0.02])
    lengths = np.diff(times, prepend=0.0)[:, None]
    kinds = {"increments": increments, "rates": increments / lengths, "path": np.cumsum(increments, axis=0)}
    results = [run(model(observation_kind=kind), zakai.Record(times, values, kind)) for kind, values in kinds.items()]
    for other in results[1:]:
        np.testing.assert_allclose(other.mean, results[0].mean, rtol=0, atol=1e-12)
        assert other.log_likelihood == pytest.approx(results[0].log_likelihood, abs=1e-11)


def test_a_path_with_a_gap_uses_the_increment_since_the_last_reading():
    # A constant state: the end of the path gives the same whether the middle was observed or not.
    still = {"state": ["x"], "drift": ["0"], "process_noise": [["0"]], "observation": ["x"], "observation_kind": "path"}
    system = zakai.Model(**still, prior={"kind": "gaussian", "mean": [0.3], "cov": [[2.0]]})
    whole = run(system, zakai.Record([0.5, 1.5], [[0.4], [1.9]], "path"))
    gap = run(system, zakai.Record([0.5, 1.5], [[np.nan], [1.9]], "path"))
    variance = 1 / (1 / 2.0 + 1.5)
    assert gap.cov[-1, 0, 0] == pytest.approx(variance, rel=1e-13)
    assert gap.mean[-1, 0] == pytest.approx(variance * (0.3 / 2.0 + 1.9), rel=1e-13)
    assert gap.log_likelihood == pytest.approx(whole.log_likelihood, abs=1e-12)
    evidence = -0.5 * np.log(1 + 3.0) + 0.5 * 1.9**2 / 1.5 - 0.5 * (1.9 - 0.45) ** 2 / (1.5 + 2.0 * 1.5**2)
    assert gap.log_likelihood == pytest.approx(evidence, abs=1e-12)


@pytest.mark.parametrize(("mean", "loses"), [(2.5, False), (3.5, True)])
def test_explicit_euler_loses_the_variance_just_where_it_outruns_the_step(mean, loses):
    variance, step = 10.0, 0.01
    assert (variance * (1 + mean**2) * step > 1) == loses
    record = zakai.Record([step], [[0.0, 0.0]], "increments")
    result = run(spiral(mean, variance), record, riccati="euler")
    assert (result.variance[-1, 0] < 0) == loses
    assert ("indefinite_cov" in str(result.warnings)) == loses
    stable = run(spiral(mean, variance), record)
    assert 0 < stable.variance[-1, 0] < variance and "indefinite_cov" not in str(stable.warnings)


def test_a_blow_up_is_a_result_with_warnings_and_the_stable_step_survives_it():
    record = zakai.simulate(spiral(0.1, 1.0), 0.01 * np.arange(1, 301), seed=5)[1]
    lost = run(spiral(12.0, 50.0), record, riccati="euler")
    assert not np.isfinite(lost.mean[-1]).all()
    assert any("the density was lost" in line for line in lost.warnings)
    kept = run(spiral(12.0, 50.0), record)
    assert np.isfinite(kept.mean).all() and np.all(kept.variance > 0)
    assert "indefinite_cov" not in str(kept.warnings)


def test_the_falling_body_keeps_its_covariance_with_singular_noise():
    system = zakai.load_model("gallery:falling-body")
    record = zakai.simulate(system, 0.05 * np.arange(1, 101), seed=2)[1]
    result = run(system, record)
    direct = kalman_bucy(system, record.values, 0.05)
    np.testing.assert_allclose(result.mean[-1], direct[0], rtol=0, atol=4e-2)
    np.testing.assert_allclose(result.cov[-1], direct[1], rtol=2e-3)
    assert not result.warnings and result.health["smallest_eigenvalue"][1:].min() > 0


def test_an_angle_stays_on_its_circle():
    system = zakai.Model(
        state=["a"],
        drift=["3"],
        process_noise=[["0.01"]],
        observation=["cos(a)", "sin(a)"],
        observation_noise=[["0.01", "0"], ["0", "0.01"]],
        observation_kind="samples",
        periodic=["a"],
        prior={"kind": "density", "log_density": "0"},
    )
    result = run(system, zakai.Record([5.0], [[np.nan, np.nan]], "samples"))
    assert result.mean[0, 0] == 0 and result.cov[0, 0, 0] == pytest.approx(np.pi**2 / 3, rel=1e-4)
    assert result.mean[1, 0] == pytest.approx(15.0 - 4 * np.pi, abs=1e-12)


def test_priors_enter_by_their_first_two_moments():
    mixture = {"kind": "mixture", "weights": [1, 3], "means": [[0, 0], [4, 0]], "covs": [[1, 1], [1, 2]]}
    record = zakai.Record([0.1], [[np.nan, np.nan]], "increments")
    result = run(model(prior=mixture), record)
    np.testing.assert_allclose(result.mean[0], [3, 0])
    np.testing.assert_allclose(result.cov[0], [[4, 0], [0, 1.75]], atol=1e-12)
    density = {"kind": "density", "log_density": "-x**2/2 - (v - 1)**2/8"}
    result = run(model(prior=density), record)
    np.testing.assert_allclose(result.mean[0], [0, 1], atol=1e-9)
    np.testing.assert_allclose(result.cov[0], [[1, 0], [0, 4]], atol=1e-9)


def test_the_densities_are_the_gaussians(increments):
    result = run(model(), zakai.Record(0.2 * np.arange(1, 11), increments, "increments"))
    for k in (0, 4, -1):
        np.testing.assert_array_equal(result.density(k).mean(), result.mean[k])
        np.testing.assert_array_equal(result.density(k).cov(), result.cov[k])


def test_auto_never_chooses_it_and_wrong_options_are_named():
    cubic = zakai.load_model("gallery:cubic-sensor")
    record = zakai.Record([0.1], [[0.0]], "increments")
    ring = zakai.Model(
        state=["a", "b", "c", "d", "e"],
        drift=["cos(b)", "cos(c)", "cos(d)", "cos(e)", "cos(a)"],
        observation=["a**3"],
        prior={"kind": "gaussian", "mean": [0.0] * 5, "cov": np.eye(5).tolist()},
    )
    assert recommended(ring) != "extended-kalman-bucy"
    for options, said in [({"riccati": "rk4"}, "riccati"), ({"substeps": 0}, "substeps"), ({"steps": 2}, "riccati, substeps")]:
        with pytest.raises(InputError, match=said):
            run(cubic, record, **options)


def test_an_oscillating_noise_is_integrated_over_every_part_of_an_interval():
    system = zakai.Model(
        state=["x"],
        drift=["-x/2"],
        observation=["2*x"],
        observation_noise=[["1 + 9/10*sin(50*t)"]],
        prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.7]]},
    )
    record = zakai.Record([0.5, 1.0], [[0.3], [np.nan]], "increments")
    exact = zakai.filter(system, record, "kalman-bucy")
    misses = [np.abs(run(system, record, substeps=count).mean - exact.mean).max() for count in (8, 16, 32)]
    assert misses[-1] < 1e-5 and misses[0] / misses[-1] > 12


@pytest.mark.filterwarnings("ignore:log_likelihood")  # the system is curved
@pytest.mark.parametrize("kind", ["increments", "samples"])
@pytest.mark.parametrize("options", [{"substeps": 3}, {"riccati": "euler", "substeps": 30}])
def test_the_log_likelihood_has_the_gradient_of_differences(kind, options):
    system = zakai.Model(
        state=["x", "y"],
        drift=["y", "-a*sin(x) - b*y"],
        observation=["sin(x) + c*t"],
        observation_noise=[["1 + 9/10*sin(50*t)*a"]],
        observation_kind=kind,
        parameters={"a": 0.8, "b": 0.3, "c": 1.2},
        periodic=["x"],
        prior={"kind": "gaussian", "mean": [3.0, 1.0], "cov": [0.5, 0.2]},
    )
    record = zakai.Record([0.1, 0.15, 0.4, 0.9], [[0.2], [np.nan], [0.3], [-0.2]], kind)
    likelihood, theta = zakai.log_likelihood(system, record, "extended-kalman-bucy", **options), system.theta()
    value, gradient = likelihood.value_and_gradient(theta)
    assert value == pytest.approx(run(system, record, **options).log_likelihood, rel=1e-12)
    for i in range(3):
        above, below = (float(likelihood(theta + shift * np.eye(3)[i])) for shift in (1e-5, -1e-5))
        assert gradient[i] == pytest.approx((above - below) / 2e-5, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_inputs_of_a_linear_system_are_exact_for_samples_and_converge_for_increments(hold):
    keys = {"inputs": ["u"], "input_hold": hold, "drift": ["v", "-2*x - v/2 + u"], "observation": ["x + u", "x + 2*v"]}
    inputs = zakai.Inputs([0.0, 0.13, 0.3, 0.61, 0.9], [1.0, -2.0, 0.5, 3.0, 1.0])
    times, values = np.array([0.1, 0.45, 0.8]), np.array([[0.2, 0.1], [-0.3, np.nan], [0.4, 0.6]])
    for kind in ("samples", "increments"):
        system, record = model(**keys, observation_kind=kind), zakai.Record(times, values, kind, inputs)
        exact = zakai.filter(system, record, method="kalman-bucy")
        errors = []
        for substeps in (1, 8, 16):
            found = run(system, record, substeps=substeps)
            parts = found.mean - exact.mean, found.cov - exact.cov, found.log_likelihood - exact.log_likelihood
            errors.append(max(np.abs(part).max() for part in parts))
        if kind == "samples":
            assert max(errors) < 1e-11
        else:
            assert errors[2] < 5e-3 and errors[2] < 0.3 * errors[1] < 0.1 * errors[0]


def test_noise_that_depends_on_the_state_is_that_at_the_mean():
    system = zakai.Model(
        state=["x"],
        drift=["-x + u"],
        diffusion=[["1/2 + 3/10*sin(x)"]],
        observation=["x"],
        observation_kind="samples",
        inputs=["u"],
        prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.2]]},
    )
    inputs = zakai.Inputs([0.0, 0.25], [2.0, -1.0])
    mean, variance = 1.0, 0.2
    for a, b, u in ((0.0, 0.25, 2.0), (0.25, 0.6, -1.0)):
        rates = lambda t, z, u=u: [-z[0] + u, -2 * z[1] + (0.5 + 0.3 * np.sin(z[0])) ** 2]  # noqa: E731
        mean, variance = solve_ivp(rates, (a, b), [mean, variance], rtol=1e-11, atol=1e-12).y[:, -1]
    record = zakai.Record([0.6], [[np.nan]], "samples", inputs)
    errors = [abs(run(system, record, substeps=count).variance[-1, 0] - variance) for count in (5, 10)]
    assert errors[1] < 1e-4 and errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"observation_kind": "samples", "observation_family": "poisson", "observation_noise": None}, "is Gaussian"),
        ({"domain": {"x": {"lower": -50.0}}}, "every state is free"),
    ],
)
def test_what_a_linearisation_cannot_follow_is_refused(keys, words):
    system = model(**keys)
    with pytest.raises(zakai.ConditionError, match=words):
        run(system, zakai.Record([0.1], [[1.0, 2.0]], system.observation_kind))


def test_it_begins_with_the_moments_of_a_density_of_three_states():
    """Each state has the law of N(1, 1/2) and N(-1, 1/4) with weights 1 and 1 / sqrt(2)."""
    names = ["x", "y", "z"]
    terms = " + ".join(f"log(exp(-({name} - 1)**2) + exp(-2*({name} + 1)**2))" for name in names)
    model = zakai.Model(
        state=names,
        drift=[f"-{name}" for name in names],
        observation=names,
        prior={"kind": "density", "log_density": terms},
    )
    result = zakai.filter(model, zakai.Record([0.1], np.zeros((1, 3)), "increments"), "extended-kalman-bucy")
    weight = 1 / (1 + np.sqrt(0.5))
    mean = 2 * weight - 1
    assert np.allclose(result.mean[0], mean, rtol=0, atol=1e-9)
    assert np.allclose(result.cov[0], (1.25 + 0.25 * weight - mean**2) * np.eye(3), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["samples", "increments"])
@pytest.mark.parametrize(("drift", "observation"), [("-x", "abs(x)"), ("x - x**3", "x")])
def test_a_system_that_is_curved_over_the_density_warns_and_a_linear_one_does_not(kind, drift, observation):
    def model(drift, observation):
        return zakai.Model(
            state=["x"], drift=[drift], observation=[observation], observation_kind=kind, observation_noise=[["1/10"]],
            prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]},
        )  # fmt: skip

    record = zakai.simulate(model(drift, observation), np.arange(1, 11) * 0.2, seed=2)[1]
    curved, grid = (zakai.filter(model(drift, observation), record, name) for name in ("extended-kalman-bucy", "yau-yau"))
    assert np.max(np.abs(curved.mean - grid.mean) / np.sqrt(grid.variance)) > 0.1
    assert any(warning.startswith("linearisation") for warning in curved.warnings)
    linear = zakai.filter(model("-x", "2*x"), record, "extended-kalman-bucy")
    assert np.nanmax(linear.health["linearisation"]) < 1e-12
    assert not any("linearis" in warning for warning in linear.warnings)


def test_a_sample_at_the_start_of_a_system_with_inputs():
    system = zakai.Model(
        state=["x", "v"], drift=["v", "-x + u"], diffusion=[[0], [0.3]], observation=["x"], observation_kind="samples",
        observation_noise=[[0.1]], inputs=["u"], prior={"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]},
    )  # fmt: skip
    times = np.array([0.0, 0.4, 0.9])
    record = zakai.Record(times, [0.3, 0.2, 0.1], "samples", inputs=zakai.Inputs(times, [0.0, 1.0, -1.0]))
    found, exact = (zakai.filter(system, record, name) for name in ("extended-kalman-bucy", "kalman-bucy"))
    assert np.allclose(found.mean, exact.mean, atol=1e-9) and found.log_likelihood == pytest.approx(exact.log_likelihood, abs=1e-9)
