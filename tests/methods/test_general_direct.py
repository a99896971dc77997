"""Gaussian sums against dense grids, Kalman filters and importance sampling, none of which shares code with them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai
from zakai.engine.likelihood import log_likelihood
from zakai.errors import ConditionError, InputError
from zakai.methods.sums import general_direct
from zakai.records.schedule import Schedule, schedule_of

LINE = np.linspace(-9.0, 9.0, 721)
FINE = np.linspace(-7.0, 7.0, 2001)
SPIRAL = ["x*sin(x)", "x*cos(x)"]


def spiral(**changes):
    keys = {
        "state": ["x"], "drift": ["-x/5"], "observation": SPIRAL,
        "prior": {"kind": "gaussian", "mean": [0.5], "cov": [[1.0]]},
    }  # fmt: skip
    return zakai.Model(**(keys | changes))


def spiral_values(x, t):
    return np.stack([x * np.sin(x), x * np.cos(x)], axis=1)


def unit_noise(t):
    return np.eye(2)


def on_a_line(record, observe=spiral_values, noise=unit_noise, substeps=20, x=LINE):
    """Return mean, variance and evidence (K,) for dx = -x/5 dt + dv, N(1/2, 1), by matrices of exact transition densities.

    Increments that act inside an interval are split finely, y linear; the others are one Gaussian factor at the end.
    """
    values = np.array(record.values, float)
    if record.kind == "rates":
        values = values * np.diff(np.append(0.0, record.times))[:, None]
    density = np.exp(-0.5 * (x - 0.5) ** 2)
    density /= density.sum()
    found, before, last, kept = [], 0.0, np.zeros((values.shape[1], 2)), {}
    for time, row in zip(record.times, values, strict=True):
        seen, step = ~np.isnan(row), (time - before) / substeps
        if record.kind == "path":
            increments, elapsed = row - last[:, 0], time - last[:, 1]
            last = np.where(seen[:, None], np.stack([row, np.full(len(row), time)], axis=1), last)
        else:
            increments, elapsed = row, np.full(len(row), time - before)
        inside = record.kind != "samples" and seen.all() and np.allclose(elapsed, time - before)
        move = kept.get(round(step, 12))
        if step > 0 and move is None:
            decay = np.exp(-0.2 * step)
            move = np.exp(-0.5 * (x[:, None] - decay * x) ** 2 / (2.5 * (1 - decay**2)))
            kept[round(step, 12)] = move = move / move.sum(axis=0)
        for part in range(substeps if step > 0 else 0):
            factor = np.ones(len(x))
            if inside:
                now = before + (part + 0.5) * step
                h, precision = observe(x, now), np.linalg.inv(noise(now))
                factor = np.exp(0.5 * (h @ precision @ increments / substeps - 0.5 * np.sum(h @ precision * h, axis=1) * step))
            density = factor * (move @ (factor * density))
        if seen.any() and not inside:
            h, block = observe(x, time)[:, seen], noise(time)[np.ix_(seen, seen)]
            if record.kind == "samples":
                away = increments[seen] - h
                logs = -0.5 * np.sum(away @ np.linalg.inv(block) * away, axis=1)
                logs -= 0.5 * np.linalg.slogdet(2 * np.pi * block)[1]
            else:
                spans = elapsed[seen]
                precision, h = np.linalg.inv(block * np.minimum(spans[:, None], spans)), h * spans
                logs = h @ precision @ increments[seen] - 0.5 * np.sum(h @ precision * h, axis=1)
            density = density * np.exp(logs)
        mass = density.sum()
        density /= mass
        mean = density @ x
        found.append((mean, density @ (x - mean) ** 2, np.log(mass)))
        before = time
    return np.array(found).T


def distance(result, reference):
    """Return the largest error of the mean in deviations, and of the log-likelihood so far."""
    mean, variance, evidence = reference
    away = np.abs(result.mean[1:, 0] - mean) / np.sqrt(variance)
    return away.max(), np.abs(np.cumsum(result.log_likelihood_increments[1:] - evidence)).max()


def warned(result):
    """Return the health figures that warn."""
    words = set(" ".join(result.warnings).replace(",", " ").replace("(", " ").split())
    return words & set(general_direct.BOUNDS)


TIMES = np.cumsum([0.02, 0.05, 0.001, 0.03, 0.04, 0.0002, 0.03, 0.01, 0.02, 0.05])


def spiral_record(kind="increments", gaps=False):
    values = zakai.simulate(spiral(), TIMES, seed=4)[1].values.copy()
    if kind == "path":
        values = np.cumsum(values, axis=0)
    if gaps:
        values[3, 1], values[5], values[7, 0] = np.nan, np.nan, np.nan
    if kind == "rates":
        values = values / np.diff(np.append(0.0, TIMES))[:, None]
    return zakai.Record(TIMES, values, kind)


@pytest.mark.parametrize(("kind", "gaps"), [("increments", False), ("increments", True), ("path", True), ("rates", False)])
def test_increments_at_irregular_times_with_gaps_agree_with_a_dense_line(kind, gaps):
    record, model = spiral_record(kind, gaps), spiral(observation_kind=kind)
    result = zakai.filter(model, record, "general-direct", components=60)
    mean, evidence = distance(result, on_a_line(record))
    assert mean <= 3e-3 and evidence <= 3e-3 and not warned(result)
    mean, evidence = distance(zakai.filter(model, record, "general-direct"), on_a_line(record))
    assert mean <= 0.02 and evidence <= 0.02


def test_the_splitting_of_lie_is_of_first_order_and_a_row_without_values_is_a_prediction():
    record = spiral_record(gaps=True)
    result = zakai.filter(spiral(), record, "general-direct", splitting="lie", components=60)
    assert 5e-3 <= distance(result, on_a_line(record))[0] <= 0.1
    assert result.log_likelihood_increments[6] == pytest.approx(0.0, abs=1e-12)
    density = result.density(-1)
    assert np.allclose(density.mean(), result.mean[-1]) and np.allclose(density.cov(), result.cov[-1])


def test_a_noise_that_oscillates_within_an_interval_is_integrated():
    def noise(t):
        return np.eye(2) * (1.0 + 0.9 * np.sin(62.8 * t))

    table = [["1 + 0.9*sin(62.8*t)", "0"], ["0", "1 + 0.9*sin(62.8*t)"]]
    with pytest.raises(ConditionError, match="quadratic"):
        zakai.filter(spiral(observation_noise=[["1", "0"], ["0", "2"]]), spiral_record(), "general-direct")
    model = spiral(observation_noise=table)
    record = spiral_record()
    result = zakai.filter(model, record, "general-direct", components=60)
    mean, evidence = distance(result, on_a_line(record, noise=noise, substeps=60))
    assert mean <= 5e-3 and evidence <= 5e-3


def test_a_sensor_that_turns_within_an_interval_is_integrated():
    def observe(x, t):
        return np.stack([x * np.sin(x + 60 * t), x * np.cos(x + 60 * t)], axis=1)

    record = spiral_record()
    result = zakai.filter(spiral(observation=["x*sin(x + 60*t)", "x*cos(x + 60*t)"]), record, "general-direct", components=60)
    mean, evidence = distance(result, on_a_line(record, observe, substeps=60))
    assert mean <= 5e-3 and evidence <= 5e-3


SENSORS = {
    "mirror": ("x**2", "0.05", np.square),
    "cubic": ("x**3", "0.05", lambda x: x**3),
    "quartic": ("x**4 - x", "0.5", lambda x: x**4 - x),
    "sine": ("sin(x)", "0.01", np.sin),
}


def sensor(name, **changes):
    observation, noise, _ = SENSORS[name]
    return spiral(observation=[observation], observation_noise=[[noise]], observation_kind="samples", **changes)


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("components", [None, 4])
def test_samples_are_near_the_density_or_a_warning_says_that_they_are_not(name, components):
    model, noise = sensor(name), np.array([[float(SENSORS[name][1])]])
    times = np.arange(0, 21) * 0.1
    record = zakai.simulate(model, times, seed=3)[1]
    result = zakai.filter(model, record, "general-direct", components=components)
    reference = on_a_line(record, lambda x, t: SENSORS[name][2](x)[:, None], lambda t: noise, 1, FINE)
    mean, evidence = distance(result, reference)
    assert (mean <= 0.05 and evidence <= 0.1) or warned(result)
    assert components is not None or (mean <= 0.1 and evidence <= 0.3)


@pytest.mark.parametrize("noise", [1e-2, 1e-8])
def test_a_sharp_sample_of_a_wide_prior_leaves_both_modes(noise):
    model = spiral(
        drift=["0"], observation=["x**2"], observation_kind="samples", observation_noise=[[repr(noise)]],
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[100.0]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(np.zeros(1), np.array([[4.0]]), "samples"), "general-direct")
    x = 2.0 + np.sqrt(noise) * np.linspace(-3, 3, 20001)
    x = np.concatenate([-x[::-1], x])
    logs = -0.5 * (x - 0.5) ** 2 / 100 - 0.5 * (x**2 - 4) ** 2 / noise - 0.5 * np.log(400 * np.pi**2 * noise)
    weight = np.exp(logs)
    mean = x @ weight / weight.sum()
    assert abs(result.mean[1, 0] - mean) <= 0.1 and result.variance[1, 0] == pytest.approx(4.0 - mean**2, rel=5e-3)
    assert result.log_likelihood == pytest.approx(np.log(weight.sum() * (x[-1] - x[-2])), abs=0.1)


def kalman(record, F, spread, C, noise, mean, cov):
    """Return mean, covariance and log-likelihood of a linear system with samples, F and spread for its one step."""
    total, found = 0.0, []
    for z in record.values:
        mean, cov = F @ mean, F @ cov @ F.T + spread
        S = C @ cov @ C.T + noise
        gain = np.linalg.solve(S, C @ cov).T
        away = z - C @ mean
        total += -0.5 * (away @ np.linalg.solve(S, away) + np.linalg.slogdet(2 * np.pi * S)[1])
        mean, cov = mean + gain @ away, cov - gain @ C @ cov
        found.append((mean, cov))
    return *map(np.array, zip(*found, strict=True)), total


def test_a_linear_system_with_singular_noise_is_the_kalman_filter():
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-x/2 - v/5"], diffusion=[["0"], ["1"]], observation=["x + v/2"],
        observation_noise=[["0.1"]], observation_kind="samples", prior={"kind": "gaussian", "mean": [1, 0], "cov": [2.0, 0.5]},
    )  # fmt: skip
    record = zakai.simulate(model, np.arange(1, 31) * 0.1, seed=1)[1]
    A, G = np.array([[0, 1], [-0.5, -0.2]]), np.diag([0.0, 1.0])
    block = expm(0.1 * np.block([[-A, G], [np.zeros((2, 2)), A.T]]))
    F = block[2:, 2:].T
    C, start = np.array([[1, 0.5]]), (np.array([1.0, 0.0]), np.diag([2.0, 0.5]))
    mean, cov, total = kalman(record, F, F @ block[:2, 2:], C, np.array([[0.1]]), *start)
    for method in ("general-direct", "gaussian-sum"):
        result = zakai.filter(model, record, method)
        assert np.abs(result.mean[1:] - mean).max() <= 1e-11 and np.abs(result.cov[1:] - cov).max() <= 1e-11
        assert result.log_likelihood == pytest.approx(total, abs=1e-9) and not result.warnings


def test_increments_of_an_affine_sensor_whose_noise_oscillates_do_not_depend_on_the_subdivision():
    model = zakai.Model(
        state=["x"], drift=["sin(t) - x"], observation=["x + t"], observation_noise=[["1 + 0.9*sin(50*t)"]],
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    times = np.cumsum([0.02, 0.5, 0.1, 0.3])
    values = np.array([[0.1], [-0.3], [0.2], [0.4]])
    whole = zakai.filter(model, zakai.Record(times, values, "increments"), "general-direct")
    fine = np.concatenate([a + (b - a) * np.arange(1, 11) / 10 for a, b in zip([0, *times[:-1]], times, strict=True)])
    parts = zakai.filter(model, zakai.Record(fine, np.repeat(values / 10, 10, axis=0), "increments"), "general-direct")
    assert np.abs(whole.mean[1:] - parts.mean[10::10]).max() <= 1e-11
    assert whole.log_likelihood == pytest.approx(parts.log_likelihood, abs=1e-11)


def scaled(kind, scale, offset, unit):
    """Return the spiral, or the mirror, of state scale x + offset and time in another unit."""
    z, noise = f"((x - ({offset!r}))/{scale!r})", f"1/{unit!r}" if kind == "increments" else "0.05"
    h = [f"{z}*sin({z})/{unit!r}", f"{z}*cos({z})/{unit!r}"] if kind == "increments" else [f"{z}**2"]
    return zakai.Model(
        state=["x"], drift=[f"-{scale!r}*{z}/5/{unit!r}"], diffusion=[[f"{scale!r}"]], process_noise=[[f"1/{unit!r}"]],
        observation=h, observation_noise=[[noise if i == j else "0" for j in range(len(h))] for i in range(len(h))],
        observation_kind=kind, prior={"kind": "gaussian", "mean": [0.5 * scale + offset], "cov": [[scale**2]]},
    )  # fmt: skip


@pytest.mark.parametrize("units", [(1e6, 0.0, 1.0), (1e-6, 0.0, 1e-3), (1.0, 1e6, 1.0), (1e3, -1e9, 1e3)])
def test_the_units_of_state_and_time_change_rounding_only(units):
    scale, offset, unit = units
    record = spiral_record()
    plain = zakai.filter(scaled("increments", 1.0, 0.0, 1.0), record, "general-direct")
    moved = zakai.Record(unit * record.times, record.values, "increments")
    result = zakai.filter(scaled("increments", *units), moved, "general-direct")
    assert np.abs((result.mean - offset) / scale - plain.mean).max() <= (1e-9 if offset else 1e-12)
    assert result.log_likelihood == pytest.approx(plain.log_likelihood, abs=1e-9)
    if offset == 0.0:
        samples = zakai.simulate(scaled("samples", 1.0, 0.0, 1.0), np.arange(1, 9) * 0.1, seed=2)[1]
        plain = zakai.filter(scaled("samples", 1.0, 0.0, 1.0), samples, "general-direct")
        result = zakai.filter(scaled("samples", scale, 0.0, 1.0), samples, "general-direct")
        assert np.abs(result.mean / scale - plain.mean).max() <= 1e-9


ENCODER = {
    "state": ["x", "v"], "drift": ["v", "-x/5 - v/5"], "diffusion": [["0.1", "0"], ["0", "1"]],
    "observation": ["sin(x)", "cos(x)"], "observation_noise": [["r**2", "0"], ["0", "r**2"]], "observation_kind": "samples",
    "parameters": {"r": 0.2}, "prior": {"kind": "gaussian", "mean": [0.5, 0], "cov": [1.0, 1.0]},
}  # fmt: skip
GRADIENTS = {
    "samples of two states": (zakai.Model(**ENCODER), 4, 0.1),
    "increments": (spiral(observation=["a*x*sin(x)", "a*x*cos(x)"], parameters={"a": 1.1}), 10, 0.01),
    "gauge": (
        spiral(drift=["a*tanh(a*x)"], observation=["c*x"], parameters={"a": 0.8, "c": 1.2}), 8, 0.1,
    ),
    "density": (
        spiral(drift=["-a*x"], parameters={"a": 0.3}, prior={"kind": "density", "log_density": "-a*x**2"}), 4, 0.01,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GRADIENTS)
def test_the_gradient_of_the_log_likelihood_is_its_slope(name):
    model, count, step = GRADIENTS[name]
    record = zakai.simulate(model, np.arange(1, count + 1) * step, seed=3)[1]
    function = log_likelihood(model, record, "general-direct")
    value, gradient = function.value_and_gradient(model.theta())
    assert value == pytest.approx(zakai.filter(model, record, "general-direct").log_likelihood, abs=1e-12)
    for i, h in enumerate(np.eye(len(gradient)) * 1e-6):
        # The grid on which a density prior is cut moves with the parameters in differences alone, and may jump in one of them.
        places = [model.theta() + k * h for k in (-8, -4, 0, 4, 8)]
        slope = np.median([(function(theta + h) - function(theta - h)) / 2e-6 for theta in places])
        assert gradient[i] == pytest.approx(slope, rel=1e-4 if name == "density" else 1e-6, abs=1e-7)


def test_what_is_prepared_for_an_interval_depends_on_that_interval_alone_to_the_bit():
    values = np.random.default_rng(0).normal(size=(len(TIMES), 2))
    values[3, 1], values[5] = np.nan, np.nan
    noise = [["1 + 0.9*sin(50*t)", "0.1"], ["0.1", "1"]]
    linear = {"state": ["x", "v"], "drift": ["v*sin(t)", "-x"], "observation": ["x + t", "v"], "observation_noise": noise}
    moving = {"observation": ["x*sin(x + 20*t)", "x*cos(x + 20*t)"]}
    gaussian = {"kind": "gaussian", "mean": [0.5, 0], "cov": [1.0, 1.0]}
    models = [spiral(), spiral(drift=["t/40*x"], **moving), zakai.Model(**linear, prior=gaussian)]
    for model in models:
        for splitting in ("strang", "lie"):
            schedule, _ = schedule_of(model, zakai.Record(TIMES, values, "path"))
            whole = general_direct.prepare(model, schedule, model.theta(), splitting=splitting)
            for k in range(len(schedule)):
                alone = general_direct.prepare(model, schedule.part(slice(k, k + 1)), model.theta(), splitting=splitting)
                pairs = [(whole.precision[k], alone.precision[0])]
                rows = [(whole.whole, alone.whole, k, 0)]
                if whole.halved[k] >= 0:
                    rows += [(whole.halves, alone.halves, 2 * whole.halved[k] + half, half) for half in (0, 1)]
                for many, one, i, j in rows:
                    pairs += [*zip(many.factors[i], one.factors[j], strict=True)]
                    pairs += [(a[i], b[j]) for a, b in zip(many.transitions, one.transitions, strict=True)]
                assert all(a is b or np.array_equal(a, b) for a, b in pairs)


def test_a_live_filter_and_a_batch_give_what_a_record_gives_to_the_bit():
    model, record = spiral(observation_kind="path"), spiral_record("path", gaps=True)
    result = zakai.filter(model, record, "general-direct")
    online = zakai.online(model, "general-direct")
    for time, value in zip(record.times, record.values, strict=True):
        estimate = online.update(time, value)
    assert np.array_equal(estimate.mean, result.mean[-1]) and np.array_equal(estimate.cov, result.cov[-1])
    other = zakai.filter(model, [spiral_record("path"), record], "general-direct")[1]
    assert np.array_equal(other.mean, result.mean) and other.log_likelihood == result.log_likelihood


def test_two_states_with_a_density_prior_or_a_gaussian_one_agree_and_coordinates_may_be_exchanged():
    def plane(order, prior):
        equations = {"x": ("-x/5 + y/3", "1"), "y": ("-y/5 - x/3", "1/2")}
        return zakai.Model(
            state=list(order), drift=[equations[name][0] for name in order],
            diffusion=[[equations[name][1] if name == other else "0" for other in order] for name in order],
            observation=["x*y", "x + y"], observation_kind="samples", observation_noise=[["0.1", "0"], ["0", "0.5"]],
            prior=prior,
        )  # fmt: skip

    gaussian = plane("xy", {"kind": "gaussian", "mean": [0.5, -0.3], "cov": [1.0, 0.6]})
    record = zakai.simulate(gaussian, np.arange(1, 6) * 0.1, seed=1)[1]
    values = record.values.copy()
    values[2], values[3, 1] = np.nan, np.nan
    record = zakai.Record(record.times, values, "samples")
    first = zakai.filter(gaussian, record, "general-direct")
    swapped = zakai.filter(
        plane("yx", {"kind": "gaussian", "mean": [-0.3, 0.5], "cov": [0.6, 1.0]}), record, "general-direct"
    )
    density = plane("xy", {"kind": "density", "log_density": "-(x - 1/2)**2/2 - (y + 3/10)**2/1.2"})
    other = zakai.filter(density, record, "general-direct")
    assert np.abs((first.mean - swapped.mean[:, ::-1]) / np.sqrt(first.variance)).max() <= 0.02
    assert np.abs((first.mean - other.mean) / np.sqrt(first.variance)).max() <= 0.02
    assert other.health["start_error"][1] <= 1e-3 and first.log_likelihood_increments[3] == pytest.approx(0.0, abs=1e-9)


def benes(variance=1.0, **changes):
    prior = {"kind": "gaussian", "mean": [0.3], "cov": [[variance]]}
    return spiral(**({"drift": ["tanh(x)"], "observation": ["x"], "observation_noise": [["0.5"]], "prior": prior} | changes))


@pytest.mark.parametrize("variance", [1e-8, 1.0, 1e8])
def test_a_prior_of_any_width_over_the_bend_of_the_gauge_agrees_with_benes(variance):
    model = benes(variance)
    record = zakai.Record(0.01 * np.arange(1, 9), np.random.default_rng(2).normal(size=(8, 1)) * 0.1 + 0.2, "increments")
    exact, result = (zakai.filter(model, record, method) for method in ("benes", "general-direct"))
    assert np.abs((result.mean - exact.mean) / np.sqrt(exact.variance)).max() <= 1e-3
    assert abs(result.log_likelihood - exact.log_likelihood) <= 1e-3 and not result.warnings


def test_a_start_that_is_not_the_prior_and_a_posterior_in_its_tails_are_reported():
    record = zakai.Record(np.array([0.01, 0.02]), np.array([[0.21], [0.14]]), "increments")
    for prior in (
        {"kind": "mixture", "weights": [0.4, 0.6], "means": [[0.1], [0.5]], "covs": [[[1e4]], [[2e4]]]},
        {"kind": "density", "log_density": "-x**2/20000"},
    ):
        assert "start_error" in warned(zakai.filter(benes(prior=prior), record, "general-direct", components=6))
    far = zakai.Record(np.array([1e-6]), np.array([[0.3]]), "increments")
    assert "edge_weight" in warned(zakai.filter(benes(1e8), far, "general-direct"))


def test_points_of_no_variance_in_the_prior_are_allowed():
    points = {"kind": "mixture", "weights": [0.3, 0.3, 0.4], "means": [[0.0], [0.1], [2.0]], "covs": [[[0.0]], [[0.0]], [[1.0]]]}
    record = zakai.Record(np.array([0.01]), np.array([[0.1]]), "increments")
    result = zakai.filter(benes(prior=points), record, "general-direct", components=10)
    assert np.isfinite(result.mean).all() and result.mean[0, 0] == pytest.approx(0.83, abs=0.01)


def test_gaps_where_only_the_observed_equation_is_linear_quadratic_are_right_and_noted():
    # q = phi'' + phi'^2 = 4 - 2 / cosh^2 x without h, 4 with it; the reference multiplies the heat kernel by cosh^2 x.
    model = spiral(drift=["2*tanh(x)"], observation=["sqrt(2)/cosh(x)"])
    times, x = np.cumsum([0.02, 0.03, 0.01, 0.02, 0.02]), np.linspace(-6, 6, 801)
    values = np.array([[0.05], [np.nan], [0.02], [-0.03], [np.nan]])
    result = zakai.filter(model, zakai.Record(times, values, "increments"), "general-direct", components=60)
    h, gauge, density, before = np.sqrt(2) / np.cosh(x), np.cosh(x) ** 2, np.exp(-0.5 * (x - 0.5) ** 2), 0.0
    for k, (time, value) in enumerate(zip(times, values[:, 0], strict=True)):
        step = (time - before) / 10
        move = np.exp(-0.5 * (x[:, None] - x) ** 2 / step)
        logs = -0.5 * step * (4 - h**2)
        if not np.isnan(value):
            logs = logs + h * value / 10 - 0.5 * h**2 * step
        for _ in range(10):
            density = gauge * np.exp(0.5 * logs) * (move @ (np.exp(0.5 * logs) * density / gauge))
        density, before = density / density.sum(), time
        mean = density @ x
        assert abs(result.mean[k + 1, 0] - mean) <= 5e-3 * np.sqrt(density @ (x - mean) ** 2)
    assert any("not linear-quadratic" in line for line in result.warnings) and not warned(result)


def test_an_angle_is_wrapped_and_an_outlier_leaves_numbers():
    model = spiral(
        state=["a"], drift=["0"], observation=["sin(a)", "cos(a)"], periodic=["a"],
        prior={"kind": "density", "log_density": "2*cos(a - 3)"},
    )  # fmt: skip
    values = np.array([[-0.05, -0.1], [-0.1, -0.1]])
    result = zakai.filter(model, zakai.Record(np.array([0.1, 0.2]), values, "increments"), "general-direct")
    assert result.mean[0, 0] == pytest.approx(3.0, abs=1e-4) and np.all(np.abs(result.mean) <= np.pi)
    assert result.health["start_error"][1] <= 1e-3
    far = spiral_record().values.copy()
    far[4] += 50.0
    result = zakai.filter(spiral(), zakai.Record(TIMES, far, "increments"), "general-direct")
    assert np.isfinite(result.mean).all() and (result.variance > 0).all() and "tail_depth" in warned(result)


def test_a_reduction_without_error_figures_says_that_it_has_none():
    record = spiral_record()
    result = zakai.filter(spiral(), record, "general-direct", reduction="algorithm-1", components=40)
    assert "no error figures" in result.warnings[0] and distance(result, on_a_line(record))[0] <= 0.5


def test_wrong_options_and_systems_outside_the_class_are_refused_in_one_line():
    model, record = zakai.Model(**ENCODER), zakai.Record(np.array([0.1]), np.zeros((1, 2)), "samples")
    for options, word in (({"reduction": "none"}, "reduction"), ({"components": 0}, "components"), ({"tolerance": 2}, "toler")):
        with pytest.raises(InputError, match=word):
            zakai.filter(model, record, "general-direct", **options)
    with pytest.raises(InputError, match="n <= 1"):
        zakai.filter(model, record, "general-direct", reduction="algorithm-1")
    with pytest.raises(ConditionError, match="depends on t"):
        increments = zakai.Record(np.array([0.1]), np.zeros((1, 2)), "increments")
        zakai.filter(spiral(drift=["t*x"]), increments, "gaussian-sum")
    prepared = general_direct.prepare(model, Schedule.empty(2), model.theta())
    state = general_direct.init(prepared, model.prior)
    assert general_direct.METHOD.valid(prepared, state)
    assert not general_direct.METHOD.valid(prepared, state._replace(first=state.first._replace(covs=state.first.covs[1:])))
