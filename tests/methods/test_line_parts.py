"""Coefficients that vary fast within the intervals between observations, against Runge-Kutta steps of the equation."""

import numpy as np
import pytest

import zakai
from references.convention import within_convention

STEPS = 800  # of Runge and Kutta, for each interval


def solved(f, G, h, S, increments, x, times, values, start, u):
    """The densities after each time, not normalised, of u_t = (G u)'' / 2 - (f u)' + (h dy/dt - h^2 / 2) u / S."""
    wave = 2j * np.pi * np.fft.fftfreq(len(x), x[1] - x[0])
    found = []
    for stop, value in zip(times, values, strict=True):
        step = (stop - start) / STEPS

        def slope(t, u, rate=value / (stop - start)):
            flow = np.fft.ifft(wave**2 * np.fft.fft(0.5 * G(t) * u) - wave * np.fft.fft(f(x, t) * u)).real
            return flow + ((h(x, t) * rate - 0.5 * h(x, t) ** 2) / S(t) * u if increments else 0.0)

        for i in range(STEPS):
            t = start + i * step
            a = slope(t, u)
            b = slope(t + step / 2, u + step / 2 * a)
            c = slope(t + step / 2, u + step / 2 * b)
            u = u + step / 6 * (a + 2 * b + 2 * c + slope(t + step, u + step * c))
        if not increments:
            u = u * np.exp(-0.5 * (value - h(x, stop)) ** 2 / S(stop)) / np.sqrt(2 * np.pi * S(stop))
        found.append(u)
        start = stop
    return found


def grid(low, high):
    return low + (high - low) * np.arange(128) / 128


CASES = {
    "forced": ("x - x**3 + cos(9*t)", lambda x, t: x - x**3 + np.cos(9 * t), {}),
    "noise": ("x - x**3", lambda x, t: x - x**3, {"G": lambda t: (0.6 + 0.3 * np.sin(12 * t)) ** 2, "g": "0.6 + 0.3*sin(12*t)"}),
    "gain": ("x - x**3", lambda x, t: x - x**3, {"h": lambda x, t: x * (1 + np.cos(14 * t)), "text": "x*(1 + cos(14*t))"}),
    "mixed": ("tanh(x + cos(8*t)) - x", lambda x, t: np.tanh(x + np.cos(8 * t)) - x, {}),
}


@pytest.mark.parametrize("increments", [False, True], ids=["samples", "increments"])
@pytest.mark.parametrize("name", CASES)
def test_coefficients_that_vary_within_intervals(name, increments):
    text, f, own = CASES[name]
    h, G = own.get("h", lambda x, t: x), own.get("G", lambda t: 0.36)
    model = zakai.Model(
        state=["x"], drift=[text], diffusion=[[own.get("g", "0.6")]], observation=[own.get("text", "x")],
        observation_noise=[["0.2"]], observation_kind="increments" if increments else "samples",
        prior={"kind": "gaussian", "mean": [0.2], "cov": [0.3]},
    )  # fmt: skip
    times = np.cumsum([0.3, 0.05, 0.55, 0.4])
    truth = np.array([0.3, 0.5, 0.6, 0.9])
    values = truth * np.diff(times, prepend=0.0) if increments else truth
    x = grid(-4.0, 4.0)
    prior = np.exp(-0.5 * (x - 0.2) ** 2 / 0.3)
    law = f, G, h, lambda t: 0.2, increments, x
    expected = solved(*law, times, values, 0.0, prior / prior.sum())
    record = zakai.Record(times, values[:, None], model.observation_kind)
    result = zakai.filter(model, record, method="yau-yau")
    assert not within_convention(result.warnings)
    for k, u in enumerate(expected, 1):
        mean = (x * u).sum() / u.sum()
        assert abs(result.mean[k, 0] - mean) < 1e-6
        assert abs(result.variance[k, 0] - ((x - mean) ** 2 * u).sum() / u.sum()) < 1e-6
    total = expected[-1].sum()
    assert abs(result.log_likelihood - np.log(total)) < 1e-6
    # The equation is linear: x(t_2) times the density there leads to its expectation given all observations.
    smoothed = zakai.smooth(model, record, method="yau-yau")
    weighted = solved(*law, times[2:], values[2:], times[1], x * expected[1])[-1].sum() / total
    assert not within_convention(smoothed.warnings)
    assert abs(smoothed.mean[2, 0] - weighted) < 1e-6


def test_a_forced_angle_around_the_end_of_its_grid():
    model = zakai.Model(
        state=["x"], drift=["sin(x) + 3*cos(7*t)"], diffusion=[["0.7"]], observation=["cos(x)"], observation_noise=[["0.2"]],
        observation_kind="samples", periodic=["x"], prior={"kind": "density", "log_density": "2*cos(x - 3)"},
    )  # fmt: skip
    times, values = np.cumsum([0.3, 0.05, 0.55, 0.4]), np.array([-0.9, -1.1, -0.6, -1.0])
    x = grid(0.0, 2 * np.pi)
    prior = np.exp(2 * np.cos(x - 3))
    law = lambda x, t: np.sin(x) + 3 * np.cos(7 * t), lambda t: 0.49, lambda x, t: np.cos(x), lambda t: 0.2, False, x
    total = np.log(solved(*law, times, values, 0.0, prior / prior.sum())[-1].sum())
    result = zakai.filter(model, zakai.Record(times, values[:, None], "samples"), method="yau-yau")
    assert not result.warnings
    assert abs(result.log_likelihood - total) < 1e-6


def test_a_forced_state_and_a_sharp_sensor():
    # The linear equation, by the joint normal law of the states at the start and at the times.
    model = zakai.Model(
        state=["x"], drift=["cos(9*t) - x"], diffusion=[["0.6"]], observation=["x"], observation_noise=[["1e-6"]],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0.2], "cov": [0.3]},
    )  # fmt: skip
    times = np.cumsum([0.2, 0.02, 0.3, 0.5, 0.05])
    values = np.array([0.5, 0.48, np.nan, 0.2, 0.3])
    smoothed = zakai.smooth(model, zakai.Record(times, values[:, None], "samples"), method="yau-yau")
    t = np.append(0.0, times)
    mean = np.exp(-t) * 0.2 + (9.0 * np.sin(9.0 * t) + np.cos(9.0 * t) - np.exp(-t)) / 82.0
    joint = np.exp(-(t[:, None] + t)) * (0.3 + 0.18 * np.expm1(2.0 * np.minimum(t[:, None], t)))
    seen = np.flatnonzero(np.isfinite(values)) + 1
    covariance = joint[np.ix_(seen, seen)] + 1e-6 * np.eye(len(seen))
    rest = values[seen - 1] - mean[seen]
    gain = joint[:, seen] @ np.linalg.inv(covariance)
    deviation = np.sqrt(np.diag(joint - gain @ joint[seen]))
    assert not smoothed.warnings
    assert np.all(np.abs(smoothed.mean[:, 0] - mean - gain @ rest) < 1e-6 * deviation)
    assert np.all(np.abs(np.sqrt(smoothed.variance[:, 0]) - deviation) < 1e-6 * deviation)
    _, log_det = np.linalg.slogdet(2.0 * np.pi * covariance)
    evidence = -0.5 * (log_det + rest @ np.linalg.solve(covariance, rest))
    assert abs(smoothed.filtered.log_likelihood - evidence) < 1e-6
