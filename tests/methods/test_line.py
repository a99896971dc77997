"""The one-state filters yau-yau and limited-direct against brute force: plain NumPy and SciPy, no code in common."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.special import erf

import zakai
from zakai.methods.grid import limited_direct, yau_yau
from zakai.records import Record
from zakai.records.schedule import schedule_of

YAU, DIRECT = yau_yau.METHOD, limited_direct.METHOD


def gaussian(mean, variance):
    return {"kind": "gaussian", "mean": [mean], "cov": [[variance]]}


def model_of(drift, observation, prior, kind="increments", noise=None, **more):
    noise = [[f"{noise}"]] if noise is not None else None
    observation = [observation] if isinstance(observation, str) else observation
    return zakai.Model(
        state=["x"], drift=[drift], observation=observation, observation_kind=kind, prior=prior,
        **({"observation_noise": noise} if noise else {}), **more,
    )  # fmt: skip


def steps(model, times, values, method=YAU, theta=None, **options):
    """Return mean, variance, log-likelihood increment and health of every step, and the last state."""
    values = np.asarray(values, float).reshape(len(times), -1)
    schedule, numbers = schedule_of(model, Record(np.asarray(times, float), values, model.observation_kind))
    theta = model.theta() if theta is None else theta
    prepared = method.prepare(model, schedule, theta, **{**method.options, **options})
    state, rows, healths = method.init(prepared, model.prior), [], []
    for k in range(len(schedule)):
        state, info = method.step(prepared, k, state, numbers[k])
        rows.append((info.mean[0], info.cov[0, 0], info.log_likelihood_increment))
        healths.append(info.health)
    return np.array(rows), healths, state


def warned(method, health):
    return any(health.get(name, 0.0) > bound for name, (bound, _) in method.bounds.items())


def distance(found, expected):
    """The largest error of mean (deviations), variance (relative) and log-likelihood increment."""
    mean = np.abs(found[:, 0] - expected[:, 0]) / np.sqrt(expected[:, 1])
    variance = np.abs(found[:, 1] / expected[:, 1] - 1)
    return max(mean.max(), variance.max(), np.abs(found[:, 2] - expected[:, 2]).max())


def kalman_bucy(a, b, G, S, m, P, times, dy):
    """dx = (a x + b(t)) dt + sqrt(G) dv, dy = x dt + dw with y linear between observations."""
    out, start = [], 0.0
    for stop, d in zip(times, dy, strict=True):
        rate = d / (stop - start)

        def slope(t, y, rate=rate):
            m, P, _ = y
            s = S(t)
            return [a * m + b(t) + P / s * (rate - m), 2 * a * P + G - P * P / s, m * rate / s - 0.5 * (m * m + P) / s]

        m, P, ll = solve_ivp(slope, (start, stop), [m, P, 0.0], rtol=1e-10, atol=1e-12, method="DOP853", max_step=0.005).y[:, -1]
        out.append((m, P, ll))
        start = stop
    return np.array(out)


def kalman(a, G, r, m, P, times, z):
    """dx = a x dt + sqrt(G) dv, samples z = x + noise of the variance r."""
    out, start = [], 0.0
    for stop, value in zip(times, z, strict=True):
        F = np.exp(a * (stop - start))
        m, P, start = F * m, F * F * P + (G * (F * F - 1) / (2 * a) if a else G * (stop - start)), stop
        s, rest = P + r, value - m
        m, P, ll = m + P / s * rest, P * r / s, -0.5 * (rest**2 / s + np.log(2 * np.pi * s))
        out.append((m, P, ll))
    return np.array(out)


TIMES = np.cumsum([0.02, 0.1, 0.5, 0.3, 0.05, 0.02])
INCREMENTS = np.random.default_rng(0).normal(0, 0.4, len(TIMES)) * np.sqrt(np.diff(TIMES, prepend=0))


@pytest.mark.parametrize("method", [YAU, DIRECT], ids=lambda m: m.name)
@pytest.mark.parametrize(
    ("text", "S"),
    [
        ("1 + 0.9*sin(50*t)", lambda t: 1 + 0.9 * np.sin(50 * t)),
        ("0.2 + 0.15*cos(62.8*t)", lambda t: 0.2 + 0.15 * np.cos(62.8 * t)),
        ("0.1", lambda t: 0.1),
    ],
)
def test_noise_that_oscillates_within_an_interval_is_integrated(method, text, S):
    model = model_of("-x/2", "x", gaussian(0.5, 1.0), noise=text)
    found, healths, _ = steps(model, TIMES, INCREMENTS, method)
    assert distance(found, kalman_bucy(-0.5, lambda t: 0.0, 1.0, S, 0.5, 1.0, TIMES, INCREMENTS)) < 1e-7
    assert not any(warned(method, health) for health in healths)


@pytest.mark.parametrize("method", [YAU, DIRECT], ids=lambda m: m.name)
def test_a_pulse_of_the_drift_within_an_interval_is_seen(method):
    model = model_of("-x/2 + 400*exp(-(t - 0.337)**2/(2*0.005**2))", "x", gaussian(0.5, 1.0), noise=0.1)
    times, dy = np.array([0.1, 0.6, 1.1]), np.array([0.05, 0.3, 1.0])
    pulse = lambda t: 400 * np.exp(-((t - 0.337) ** 2) / 2 / 0.005**2)  # noqa: E731
    expected = kalman_bucy(-0.5, pulse, 1.0, lambda t: 0.1, 0.5, 1.0, times, dy)
    assert distance(steps(model, times, dy, method)[0], expected) < 1e-6


@pytest.mark.parametrize("method", [YAU, DIRECT], ids=lambda m: m.name)
def test_sharp_samples_of_a_wide_prior(method):
    model = model_of("-x/2", "x", gaussian(3.0, 1e4), "samples", 1e-4)
    times, z = np.array([0.5, 1.0, 50.0, 51.0]), np.array([120.0, 93.3, 0.3, 0.2])
    found, healths, _ = steps(model, times, z, method)
    assert distance(found, kalman(-0.5, 1.0, 1e-4, 3.0, 1e4, times, z)) < 1e-7
    assert not any(warned(method, health) for health in healths)


@pytest.mark.parametrize("method", [YAU, DIRECT], ids=lambda m: m.name)
def test_a_state_far_from_zero(method):
    times, z = np.array([0.0, 0.5, 1.0, 50.0]), np.array([0.0, 1.0, 2.0, 5.0])
    model = model_of("0", "x", gaussian(1e6, 0.5), "samples", 0.5)
    assert distance(steps(model, times, 1e6 + z, method)[0], kalman(0.0, 1.0, 0.5, 1e6, 0.5, times, 1e6 + z)) < 1e-8
    model = model_of("0", "x - 1000000", gaussian(1e6, 0.5), noise=0.5)
    near = model_of("0", "x", gaussian(0.0, 0.5), noise=0.5)
    far, found = (steps(one, TIMES, INCREMENTS, method)[0] for one in (model, near))
    far[:, 0] -= 1e6
    assert distance(far, found) < 1e-8


@pytest.mark.parametrize("x_unit", [1e-6, 1e6])
@pytest.mark.parametrize("t_unit", [1e-3, 1e3])
def test_units_change_nothing_but_rounding(x_unit, t_unit):
    u, v = repr(x_unit), repr(t_unit)
    model = model_of("x - x**3", "x**3", gaussian(-0.8, 0.09), noise=0.3, diffusion=[["0.7"]])
    scaled = model_of(
        f"(x/{u} - (x/{u})**3)*{u}/{v}", f"(x/{u})**3/{v}", gaussian(-0.8 * x_unit, 0.09 * x_unit**2), noise=repr(0.3 / t_unit),
        diffusion=[[f"0.7*{u}/sqrt({v})"]],
    )  # fmt: skip
    found, expected = steps(scaled, TIMES * t_unit, INCREMENTS)[0], steps(model, TIMES, INCREMENTS)[0]
    found[:, 0], found[:, 1] = found[:, 0] / x_unit, found[:, 1] / x_unit**2
    assert distance(found, expected) < 1e-8


FUNCTIONS = {
    "sin(x)": np.sin, "cos(x)": np.cos, "tan(x/4)": lambda x: np.tan(x / 4), "asin(x/9)": lambda x: np.arcsin(x / 9),
    "acos(x/9)": lambda x: np.arccos(x / 9), "atan(x)": np.arctan, "sinh(x)": np.sinh, "cosh(x)": np.cosh, "tanh(x)": np.tanh,
    "exp(x)": np.exp, "log(x + 9)": lambda x: np.log(x + 9), "sqrt(x + 9)": lambda x: np.sqrt(x + 9),
    "abs(x - 1.3)": lambda x: abs(x - 1.3), "erf(x)": erf, "x**5": lambda x: x**5, "1/(x + 9)": lambda x: 1 / (x + 9),
}  # fmt: skip


def bayes(h, z, r, mean, variance, low=-5.0, high=7.0):
    """Posterior moments and evidence of one sample by a sum over half a million points."""
    x = np.linspace(low, high, 500_001)
    w = np.exp(-0.5 * (x - mean) ** 2 / variance - 0.5 * (z - h(x)) ** 2 / r) / (2 * np.pi * np.sqrt(variance * r))
    total = w.sum()
    m = (x * w).sum() / total
    return np.array([[m, ((x - m) ** 2 * w).sum() / total, np.log(total * (x[1] - x[0]))]])


@pytest.mark.parametrize("text", FUNCTIONS)
def test_every_function_of_the_grammar_against_bayes(text):
    h = FUNCTIONS[text]
    model = model_of("0", text, gaussian(1.0, 0.2), "samples", 0.01)
    z = float(h(np.array(1.25)))
    found, healths, _ = steps(model, [0.0], [z])
    error = distance(found, bayes(h, z, 0.01, 1.0, 0.2))
    assert error < (1e-4 if "abs" in text else 1e-9)
    assert error < 10 * healths[0]["error_estimate"] + 1e-9


def collocation(f, G, half, size):
    """The forward operator on [-half, half) by the trigonometric interpolant."""
    x = half * (2.0 * np.arange(size) / size - 1)
    k = 2 * np.pi * np.fft.fftfreq(size, 2 * half / size)
    columns = np.fft.fft(np.eye(size), axis=0)
    once = np.fft.ifft((1j * np.where(np.arange(size) == size // 2, 0, k))[:, None] * columns, axis=0).real
    twice = np.fft.ifft(-(k**2)[:, None] * columns, axis=0).real
    return x, 0.5 * G * twice - once * f(x)


def brute_force(f, G, hs, S, prior, times, values, kind, half=6.0, size=256):
    """Mean, variance and evidence by matrix exponentials; nan is not observed; y is linear between observations."""
    x, operator = collocation(f, G, half, size)
    u = prior(x) / prior(x).sum()
    out, start = [], 0.0
    for stop, value in zip(times, values, strict=True):
        seen = np.flatnonzero(~np.isnan(value))
        tau = stop - start
        matrix = tau * operator
        h = np.array([hs[i](x) for i in seen]).reshape(len(seen), size)
        if kind == "increments":
            for i, row in zip(seen, h, strict=True):
                matrix = matrix + np.diag((row * value[i] - 0.5 * tau * row**2) / S[i])
        u = expm(matrix) @ u
        gained = np.log(u.sum())
        if kind == "samples":
            logs = sum((-0.5 * (value[i] - row) ** 2 / S[i] for i, row in zip(seen, h, strict=True)), 0.0 * x)
            u = u / u.sum() * np.exp(logs)
            gained += np.log(u.sum()) - 0.5 * sum(np.log(2 * np.pi * S[i]) for i in seen)
        u = u / u.sum()
        m = x @ u
        out.append((m, (x - m) ** 2 @ u, gained))
        start = stop
    return np.array(out)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_double_well_at_irregular_times_with_gaps(kind):
    rng = np.random.default_rng(1)
    times = np.cumsum(np.r_[rng.uniform(0.02, 0.75, 12), 8.0, 1e-3, 0.2])
    model = model_of(
        "x - x**3", ["x**3", "sin(2*x)"], gaussian(-0.8, 0.09), kind, diffusion=[["0.7"]],
        observation_noise=[["0.5", "0"], ["0", "0.2"]],
    )  # fmt: skip
    values = zakai.simulate(model, times, seed=3)[1].values.copy()
    values[rng.uniform(size=values.shape) < 0.25] = np.nan
    values[4] = np.nan
    hs, prior = (lambda x: x**3, lambda x: np.sin(2 * x)), lambda x: np.exp(-0.5 * (x + 0.8) ** 2 / 0.09)
    expected = brute_force(lambda x: x - x**3, 0.49, hs, (0.5, 0.2), prior, times, values, kind, 3.5)
    found, healths, _ = steps(model, times, values)
    assert distance(found, expected) < 1e-7
    assert not any(warned(YAU, health) for health in healths)


@pytest.mark.parametrize("method", [YAU, DIRECT], ids=lambda m: m.name)
def test_the_spiral_sensor_with_missing_coordinates(method):
    model = zakai.Model(
        state=["x"], drift=["x/40"], observation=["x*sin(x)", "x*cos(x)"], observation_noise=[["1", "0"], ["0", "1"]],
        prior=gaussian(0.1, 0.3),
    )  # fmt: skip
    times = np.cumsum(np.random.default_rng(5).uniform(0.005, 0.05, 30))
    values = zakai.simulate(model, times, seed=0)[1].values.copy()
    values[np.random.default_rng(6).uniform(size=values.shape) < 0.3] = np.nan
    hs, prior = (lambda x: x * np.sin(x), lambda x: x * np.cos(x)), lambda x: np.exp(-0.5 * (x - 0.1) ** 2 / 0.3)
    expected = brute_force(lambda x: x / 40, 1.0, hs, (1.0, 1.0), prior, times, values, "increments", 9.0, 320)
    assert distance(steps(model, times, values, method, tolerance=1e-9)[0], expected) < 1e-8
    found, healths, _ = steps(model, times, values, method)
    assert distance(found, expected) < 2e-6 and not any(warned(method, health) for health in healths)


def test_the_order_of_the_papers_is_at_hand():
    """The transition with the potential -h'S^-1 h / 2 and then exp(h'S^-1 dy)."""
    model = model_of("0", ["x*sin(x)", "x*cos(x)"], gaussian(0.1, 0.3))
    times, dy = np.array([0.1, 0.3]), np.array([[0.2, -0.1], [0.1, 0.3]])
    x, operator = collocation(lambda x: 0.0 * x, 1.0, 9.0, 320)
    u, start, expected = np.exp(-0.5 * (x - 0.1) ** 2 / 0.3), 0.0, []
    for stop, d in zip(times, dy, strict=True):
        u = expm((stop - start) * (operator - 0.5 * np.diag(x**2))) @ (u / u.sum())
        u, start = u * np.exp(x * np.sin(x) * d[0] + x * np.cos(x) * d[1]), stop
        m = x @ u / u.sum()
        expected.append((m, (x - m) ** 2 @ u / u.sum(), np.log(u.sum())))
    assert distance(steps(model, times, dy, DIRECT, splitting="lie")[0], np.array(expected)) < 1e-9


@pytest.mark.parametrize("drift", ["0", "0.7 + 0.4*sin(x)"])
def test_an_angle_at_irregular_times_with_gaps(drift):
    model = model_of(
        drift, ["cos(x)", "sin(x)"], {"kind": "density", "log_density": "0"}, "samples", diffusion=[["0.4"]],
        observation_noise=[["0.05", "0"], ["0", "0.05"]], periodic=["x"],
    )  # fmt: skip
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.05, 2.0, 40))
    values = zakai.simulate(model, times, seed=1)[1].values.copy()
    values[rng.uniform(size=values.shape) < 0.12] = np.nan
    x, operator = collocation((lambda x: 0.7 + 0.4 * np.sin(x)) if drift != "0" else (lambda x: 0.0 * x), 0.16, np.pi, 200)
    u, start, expected = np.ones(len(x)) / len(x), 0.0, []
    for stop, value in zip(times, values, strict=True):
        u = expm((stop - start) * operator) @ u
        logs = np.zeros(len(x))
        for number, h in zip(value, (np.cos(x), np.sin(x)), strict=True):
            if not np.isnan(number):
                logs += -0.5 * (number - h) ** 2 / 0.05 - 0.5 * np.log(2 * np.pi * 0.05)
        u, start = u * np.exp(logs), stop
        expected.append((np.angle(np.exp(1j * x) @ u), np.log(u.sum())))
        u = u / u.sum()
    found = steps(model, times, values)[0]
    wrapped = np.angle(np.exp(1j * (found[:, 0] - np.array(expected)[:, 0])))
    assert np.abs(wrapped).max() < 1e-9 and np.abs(found[:, 2] - np.array(expected)[:, 1]).max() < 1e-8


def test_a_kink_is_accepted_and_its_error_estimated():
    model = model_of("-abs(x)*x - 0.3*abs(x - 0.2)", "abs(x + 0.1)", gaussian(0.1, 0.2), "samples", 0.1)
    times, z = 0.3 * np.arange(1, 4), np.array([0.4, 0.2, 0.5])
    prior = lambda x: np.exp(-0.5 * (x - 0.1) ** 2 / 0.2)  # noqa: E731
    drift = lambda x: -abs(x) * x - 0.3 * abs(x - 0.2)  # noqa: E731
    coarse, fine = (
        brute_force(drift, 1.0, (lambda x: abs(x + 0.1),), (0.1,), prior, times, z[:, None], "samples", 5.0, size)
        for size in (400, 800)
    )
    found, healths, _ = steps(model, times, z)
    own = np.abs(coarse - fine).max()
    for row, expected, health in zip(found, fine, healths, strict=True):
        assert distance(row[None], expected[None]) < 10 * health["error_estimate"] + 4 * own
    assert distance(found, fine) < 1e-3


@pytest.mark.parametrize(
    ("method", "keys"),
    [
        (YAU, dict(drift="k*(x - x**3)", observation="x", kind="samples")),
        (YAU, dict(drift="k*(x - x**3)", observation="x", kind="increments")),
        (YAU, dict(drift="-k*x + sin(3*t)", observation="x**2", kind="increments")),
        (DIRECT, dict(drift="-k*x*(1 + cos(t)/2)", observation="x**2", kind="samples")),
        (DIRECT, dict(drift="-k*x", observation="x", kind="increments")),
    ],
    ids=lambda value: getattr(value, "name", None) or value["drift"] + " " + value["kind"],
)
def test_gradients_by_the_complex_step(method, keys):
    model = model_of(prior=gaussian(0.3, 0.5), noise="r", parameters={"k": 1.2, "r": 0.1}, **keys)
    times = np.cumsum(np.random.default_rng(3).uniform(0.1, 0.5, 8))
    values = zakai.simulate(model, times, seed=1)[1].values

    def evidence(theta):
        return steps(model, times, values, method, theta=theta, tolerance=1e-8)[0][:, 2].sum()

    theta = model.theta()
    for direction in np.eye(2):
        h = 1e-3
        differences = [(evidence(theta + c * h * direction) - evidence(theta - c * h * direction)) / (2 * c * h) for c in (1, 2)]
        expected = (4 * differences[0] - differences[1]) / 3
        found = evidence(theta + 1e-150j * direction)
        assert abs(found.imag / 1e-150 - expected) < 1e-6 * max(abs(expected), 0.1)
        assert abs(found.real - evidence(theta)) < 1e-8


@pytest.mark.parametrize("method", [YAU, DIRECT], ids=lambda m: m.name)
def test_an_interval_depends_on_itself_alone(method):
    model = model_of("-x", "x**2", gaussian(0.3, 0.5), noise="0.2 + 0.1*cos(9*t)")
    values = zakai.simulate(model, TIMES, seed=1)[1].values
    whole = steps(model, TIMES, values, method)[2]
    schedule, numbers = schedule_of(model, Record(TIMES, values, "increments"))
    state = None
    for k in range(len(schedule)):
        prepared = method.prepare(model, schedule.part(slice(k, k + 1)), model.theta(), **method.options)
        state = method.init(prepared, model.prior) if state is None else state
        state, _ = method.step(prepared, 0, state, numbers[k])
    assert all(np.array_equal(a, b) for a, b in zip(whole, state, strict=True))


def test_a_path_with_gaps_is_a_factor_over_the_time_since_the_last_observation():
    model = model_of("-x", ["x", "2*x"], gaussian(0.3, 0.5), "path", observation_noise=[["0.2", "0"], ["0", "0.3"]])
    times, path = np.array([0.1, 0.2, 0.4]), np.array([[0.1, np.nan], [np.nan, 0.3], [0.2, 0.5]])
    x, operator = collocation(lambda x: -x, 1.0, 6.0, 256)
    u = np.exp(-0.5 * (x - 0.3) ** 2 / 0.5)
    rows = [(0.1, 0.1 * x / 0.2 - 0.05 * x**2 / 0.2, None)]
    rows += [(0.1, 0.0 * x, (0.3, 0.2, 0.3, 2 * x)), (0.2, 2 * x * 0.2 / 0.3 - 0.1 * 4 * x**2 / 0.3, (0.1, 0.3, 0.2, x))]
    expected = []
    for tau, potential, factor in rows:
        u = expm(tau * operator + np.diag(potential)) @ (u / u.sum())
        if factor is not None:
            dy, elapsed, noise, h = factor
            u = u * np.exp(h * dy / noise - 0.5 * h**2 * elapsed / noise)
        m = x @ u / u.sum()
        expected.append((m, (x - m) ** 2 @ u / u.sum(), np.log(u.sum())))
    assert distance(steps(model, times, path, tolerance=1e-10)[0], np.array(expected)) < 1e-9
    assert distance(steps(model, times, path)[0], np.array(expected)) < 1e-6


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_steps_together_are_the_same_to_the_last_bit(kind):
    model = model_of("x - x**3", "x**3", gaussian(-0.8, 0.09), kind, 0.3, diffusion=[["0.7"]])
    times = np.cumsum(np.random.default_rng(4).uniform(1e-3, 0.02, 120))
    times[60:] += 3.0
    values = zakai.simulate(model, times, seed=2)[1].values.copy()
    values[::7] = np.nan
    found, healths, last = steps(model, times, values)
    schedule, numbers = schedule_of(model, Record(times, values, kind))
    prepared = YAU.prepare(model, schedule, model.theta())
    states, infos = YAU.segment(prepared, slice(0, len(times)), YAU.init(prepared, model.prior), numbers)
    assert np.array_equal(infos.mean[:, 0], found[:, 0]) and np.array_equal(infos.log_likelihood_increment, found[:, 2])
    assert all(np.array_equal(a, b) for a, b in zip(states[-1], last, strict=True))
    assert np.array_equal(infos.health["error_estimate"], [health["error_estimate"] for health in healths])
    exact = steps(model, times, values, tolerance=1e-11)[0]
    error = np.maximum.accumulate(np.abs(found[:, 0] - exact[:, 0]) / np.sqrt(exact[:, 1]))
    assert error.max() < 1e-5 and np.all(error < 10 * np.maximum.accumulate(infos.health["error_estimate"]) + 1e-9)


def test_an_outlier_is_not_passed_over_in_silence():
    model = model_of("-x", "x", gaussian(0.0, 1.0), "samples", 0.01)
    for method in (YAU, DIRECT):
        found, healths, _ = steps(model, np.arange(1, 6) / 2, [0.1, 50.0, 0.1, 0.0, 0.1], method)
        expected = kalman(-1.0, 1.0, 0.01, 0.0, 1.0, np.arange(1, 6) / 2, [0.1, 50.0, 0.1, 0.0, 0.1])
        assert warned(method, healths[1]) or distance(found[1:2], expected[1:2]) < 1e-4
        assert np.isfinite(found).all() and abs(found[-1, 0] - expected[-1, 0]) < 0.1 * np.sqrt(expected[-1, 1])


@pytest.mark.parametrize("options", [{"tolerance": 0}, {"tolerance": "fine"}])
def test_an_option_that_makes_no_sense_is_refused(options):
    with pytest.raises(zakai.InputError, match="option tolerance"):
        steps(model_of("-x", "x", gaussian(0.0, 1.0)), [0.1], [0.1], **options)


def test_a_long_gap_of_a_double_well_and_a_wide_prior_with_weak_noise():
    model = model_of("x - x**3", "x", gaussian(0.1, 1.0), diffusion=[["0.3"]])
    times, dy = np.array([0.5, 300.0, 301.0]), np.array([0.2, 3.0, 0.1])
    prior = lambda x: np.exp(-0.5 * (x - 0.1) ** 2)  # noqa: E731
    found, healths, _ = steps(model, times, dy)
    assert not any(warned(YAU, health) for health in healths)
    # The wide tails of the prior are on no fixed grid; what matters is on this one.
    expected = brute_force(lambda x: x - x**3, 0.09, (lambda x: x,), (1.0,), prior, times, dy[:, None], "increments", 4.5, 400)
    assert np.abs(found[1:] - expected[1:])[:, :2].max() < 1e-3 and abs(found[0, 2] - expected[0, 2]) < 1e-3


def test_densities_much_sharper_than_the_noise_of_an_interval():
    model = model_of("0.9*sin(2*x) - 0.3*x", "tanh(2*x)", gaussian(0.5, 0.3), "samples", 0.01, diffusion=[["0.6"]])
    times, values = np.array([0.3, 0.9, 1.0, 2.1, 2.6]), np.array([0.3, -0.2, 0.1, 0.5, 0.95])
    found, healths, _ = steps(model, times, values)
    assert not any(warned(YAU, health) for health in healths)
    prior = lambda x: np.exp(-0.5 * (x - 0.5) ** 2 / 0.3)  # noqa: E731
    drift, h = (lambda x: 0.9 * np.sin(2 * x) - 0.3 * x), (lambda x: np.tanh(2 * x))
    expected = brute_force(drift, 0.36, (h,), (0.01,), prior, times, values[:, None], "samples", 5.0, 400)
    assert distance(found, expected) < 1e-8


def test_the_large_grid_of_a_wide_prior_is_left_again():
    model = model_of("1.2*(x - x**3)", "x", gaussian(0.0, 1.0), "samples", 0.2, diffusion=[["0.7"]])
    record = Record(0.1 * np.arange(1, 11), np.linspace(0.9, 1.1, 10)[:, None], "samples")
    assert len(zakai.filter(model, record).density(-1).points) <= 128


def test_an_interval_in_which_the_evidence_underflows():
    model = model_of("-x", "x", gaussian(0.1, 1.0), noise=1)
    times, dy = np.array([0.5, 2e4, 2e4 + 1]), np.array([0.2, 3.0, 0.1])
    yau, direct = (steps(model, times, dy, method)[0] for method in (YAU, DIRECT))
    assert np.abs(yau[:, :2] - direct[:, :2]).max() < 1e-6 and abs(yau[1, 2] / direct[1, 2] - 1) < 1e-9


def test_a_prior_without_width_is_refused():
    with pytest.raises(zakai.InputError, match="variance is zero"):
        steps(model_of("-x", "x", gaussian(0.0, 0.0)), [0.1], [0.1])


def test_priors_of_all_kinds_are_the_same_density():
    kinds = [
        gaussian(0.4, 0.6),
        {"kind": "mixture", "weights": [0.3, 0.7], "means": [[0.4], [0.4]], "covs": [[[0.6]], [[0.6]]]},
        {"kind": "density", "log_density": "-(x - 0.4)**2/1.2"},
    ]
    first, *others = (steps(model_of("cos(x)", "x**3", prior), TIMES, INCREMENTS)[0] for prior in kinds)
    for other in others:
        assert distance(other, first) < 1e-9


def test_the_density_is_that_of_the_moments():
    model = model_of("cos(x)", "x**3", gaussian(0.4, 0.6))
    found, _, state = steps(model, TIMES, INCREMENTS)
    prepared = YAU.prepare(model, schedule_of(model, Record(TIMES, INCREMENTS[:, None], "increments"))[0], model.theta())
    density = YAU.density(prepared, state)
    assert abs(density.mean()[0] - found[-1, 0]) < 1e-9 and abs(density.cov()[0, 0] - found[-1, 1]) < 1e-9


def varying_record(kind):
    """A time-varying Yau system, irregular times and gaps."""
    rng = np.random.default_rng(5)
    times = np.cumsum(np.exp(rng.uniform(np.log(0.002), np.log(0.03), 120)))
    if kind == "increments":
        model = model_of("t/4*x", ["x*sin(x)", "x*cos(x)"], gaussian(0.1, 0.5))
    else:
        model = model_of("sin(t)*x/2 + cos(t) - x/2", ["x + sin(x)/2", "x"], gaussian(0.1, 0.5), "samples",
                         observation_noise=[["0.2", "0"], ["0", "0.3 + t/9"]])  # fmt: skip
    values = np.array(zakai.simulate(model, times, seed=4)[1].values)
    values[rng.random(values.shape) < 0.2] = np.nan
    values[40:44] = np.nan
    return model, times, values


@pytest.mark.parametrize("kind", ["increments", "samples"])
def test_gaussian_kernels_in_the_loop_agree_with_single_steps(kind, monkeypatch):
    model, times, values = varying_record(kind)
    found, healths, _ = steps(model, times, values, DIRECT)
    schedule, numbers = schedule_of(model, Record(times, values, model.observation_kind))
    prepared = DIRECT.prepare(model, schedule, model.theta(), **DIRECT.options)
    assert np.mean(prepared.fast) > 0.9
    assert DIRECT.segment is not None
    states, infos = DIRECT.segment(prepared, slice(0, len(times)), DIRECT.init(prepared, model.prior), numbers)
    together = np.stack([infos.mean[:, 0], infos.cov[:, 0, 0], infos.log_likelihood_increment], axis=1)
    assert np.array_equal(together, found)
    monkeypatch.setattr("zakai.methods.line.loop.compiled_steps", lambda *arguments: [])
    slow, _, _ = steps(model, times, values, DIRECT, tolerance=1e-9)
    assert distance(found, slow) < 2e-7
    assert not any(warned(DIRECT, health) for health in healths)
