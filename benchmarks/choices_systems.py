"""Systems of two to six states for which `auto` chooses a method: the model, the mean interval, rows, and inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import zakai


class System(NamedTuple):
    """Keys of a model, the mean length of an interval, the number of rows, and the inputs as a function of t."""

    keys: dict[str, Any]
    length: float
    rows: int = 30
    inputs: Callable[[np.ndarray], list[np.ndarray]] | None = None

    def problem(self) -> tuple[zakai.Model, zakai.Record]:
        """Return the model and a record at irregular times, with a gap and a row without observation."""
        model = zakai.Model(**self.keys)
        rng = np.random.default_rng(11)
        times = self.length * np.cumsum(rng.uniform(0.5, 1.5, self.rows))
        times[self.rows // 2 :] += 3 * self.length
        given = None
        if self.inputs is not None:
            at = np.linspace(0.0, times[-1], 4 * self.rows)
            given = zakai.Inputs(at, np.stack(self.inputs(at), axis=1))
        _, record = zakai.simulate(model, times, seed=4, substeps=500, inputs=given)
        values = record.values.copy()
        values[self.rows // 3] = np.nan
        return model, zakai.Record(record.times, values, record.kind, inputs=given)


def system(
    state: str, drift: list[str], noise: dict[str, str], observation: list[str], variances: list[float], mean: list[float],
    cov: list[float], length: float, **more: Any,
) -> System:  # fmt: skip
    """Return a system whose states of `noise` have independent noises; `rows` and `inputs_at` are not keys of a model."""
    names = state.split()
    given = {key: more.pop(key) for key in ("rows",) if key in more}
    inputs = more.pop("inputs_at", None)
    keys = {
        "state": names, "drift": drift,
        "diffusion": [[noise[name] if name == other else "0" for other in noise] for name in names],
        "observation": observation, "observation_noise": np.diag(variances).tolist(), "observation_kind": "samples",
        "prior": {"kind": "gaussian", "mean": mean, "cov": cov},
    }  # fmt: skip
    return System(keys | more, length, inputs=inputs, **given)


def _current(t: np.ndarray) -> list[np.ndarray]:
    return [0.5 + 0.5 * np.sign(np.sin(t / 200))]


_CELL = "3.2 + 0.8*soc + 0.15*tanh(10*(soc - 0.9)) - 0.3*exp(-20*soc) - v1{} - 0.02*I"
def _log_normal(means: dict[str, float], sd: float) -> dict[str, str]:
    """Return the prior of positive states whose logarithms are Gaussian."""
    parts = [f"-(log({name}) - ({mean}))**2/(2*{sd}**2) - log({name})" for name, mean in means.items()]
    return {"kind": "density", "log_density": " ".join(parts)}


_POSITIVE = {"x": {"lower": 0.0}, "y": {"lower": 0.0}}
_OSCILLATORS = ["u", "-q - 0.3*q**3 + 0.5*(r - q) - 0.1*u", "w", "-2*r + 0.5*(q - r) - 0.1*w"]
_L96 = [f"(x{(i + 1) % 6} - x{(i - 2) % 6})*x{(i - 1) % 6} - x{i} + 8" for i in range(6)]

SYSTEMS: dict[str, System] = {
    # two states
    "pendulum": system("a w", ["w", "-2*sin(a) - 0.2*w"], {"w": "0.5"}, ["sin(a)"], [0.01], [0.5, 0], [1, 1],
                       0.3, periodic=["a"]),
    "van-der-pol": system("x v", ["v", "2*(1 - x**2)*v - x"], {"v": "0.5"}, ["x"], [0.05], [1, 0], [0.5, 0.5], 0.05,
                          observation_kind="increments", rows=150),
    "lotka": system("x y", ["x - 0.5*x*y", "0.4*x*y - 0.6*y"], {"x": "0.15*x", "y": "0.15*y"}, ["10*x", "10*y"], [1, 1], [2, 2],
                    [0.1, 0.1], 0.4, observation_family="poisson", domain={"x": {"lower": 0.0}, "y": {"lower": 0.0}}),
    "heston": System({
        "state": ["s", "v"], "drift": ["-v/2", "2*(0.3 - v)"], "diffusion": [["sqrt(v)", "0"], ["-0.3*sqrt(v)", "0.3*sqrt(v)"]],
        "observation": ["s"], "observation_kind": "samples", "observation_noise": [[1e-3]], "domain": {"v": {"lower": 0.0}},
        "prior": {"kind": "gaussian", "mean": [0, 0.3], "cov": [1e-3, 2e-3]}}, 0.1),
    "leverage": System({
        "state": ["a", "b"], "drift": ["-a", "-5*b"], "diffusion": [["0.5", "0"], ["0", "1.2"]],
        "cross_noise": [["-0.5*0.2"], ["0"]],
        "observation": ["0.5 - a**2/4 + b/5"], "observation_kind": "increments", "observation_noise": [[0.04]],
        "prior": {"kind": "gaussian", "mean": [0, 0], "cov": [0.2, 0.2]}}, 0.1, 60),
    "sir-2": system("s i", ["-0.9*s*i", "0.9*s*i - 0.3*i"], {"i": "0.15*i"}, ["1000*i"], [1], [0.95, 0.02], [4e-4, 1.6e-5], 0.5,
                    observation_family="poisson", domain={"s": {"lower": 0.0}, "i": {"lower": 0.0}}),
    "stiff": system("x y", ["-200*(x - sin(y))", "1 - 0.5*y"], {"x": "2", "y": "0.4"}, ["x + 0.2*y"], [0.01], [0, 0], [1, 1],
                    0.5),
    "battery-1": system("soc v1", ["-I/8280", "I/1500 - v1/30"], {"soc": "2e-5", "v1": "1e-4"}, [_CELL.format("")], [2.5e-5],
                        [0.7, 0], [0.02, 1e-4], 60.0, inputs=["I"], inputs_at=_current),
    "decay": system("x a", ["-a*x + 1", "0"], {"x": "0.05", "a": "1e-3"}, ["x + 0.1*x**2"], [1e-3], [2, 1], [1, 0.5], 0.3),
    "duffing-long": system("x v", ["v", "x - x**3 - 0.2*v"], {"v": "0.4"}, ["x"], [0.01], [0, 0], [1, 1], 4.0),
    "ring": system("x y", ["-0.1*x", "-0.1*y"], {"x": "0.3", "y": "0.3"},
                   ["sqrt(x**2 + y**2)", "atan2(y - 1, x + 2)"], [1e-4, 0.3],
                   [2, 0], [2, 2], 0.5),
    "car": system("p v", ["v", "-0.8*cos(p/2) - 0.1*v*abs(v) + 1"], {"v": "0.5"}, ["4*sin(p/2) + p/10"], [0.09], [0, 2], [4, 0.5],
                  0.3),
    "relaxation": system("x v", ["v", "50*(1 - x**2)*v - x"], {"v": "0.5"}, ["x"], [0.01], [1.5, 0], [0.1, 0.1], 0.3, rows=16),
    "tanks": system("a b", ["0.05 - 0.2*sqrt(abs(a))", "0.2*sqrt(abs(a)) - 0.2*sqrt(abs(b))"], {"a": "0.01", "b": "0.01"}, ["b"],
                    [1e-4], [0.1, 0.1], [0.01, 0.01], 2.0, rows=16),
    "friction": system("w i", ["5*i - 0.5*w - 2*tanh(w/0.02)", "20*(u - i - 0.2*w)"], {"w": "0.3", "i": "0.3"}, ["w"], [0.01],
                       [0, 0], [0.5, 0.2], 0.1, rows=16, inputs=["u"], inputs_at=lambda t: [np.sin(2 * t)]),
    "predators": system("x y", ["x - 0.5*x*y", "0.4*x*y - 0.6*y"], {"x": "0.15*x", "y": "0.15*y"}, ["x", "y"], [0.04, 0.04], [],
                        [], 0.5, rows=16, domain=_POSITIVE, prior=_log_normal({"x": 0.7, "y": 0.7}, 0.2)),
    "brusselator": system("x y", ["1 - 4*x + x**2*y", "3*x - x**2*y"], {"x": "0.1", "y": "0.1"}, ["x"], [0.02], [1, 3],
                          [0.1, 0.2], 0.5, rows=16),
    "enzyme": system("s c", ["-10*s*(1 - c) + 2*c", "10*s*(1 - c) - 3*c"], {"s": "0.05", "c": "0.03"}, ["s"], [1e-3], [1, 0.3],
                     [0.04, 0.01], 0.15, rows=16),
    "growth": system("c s", ["(s/(0.5 + s) - 0.3)*c", "0.3*(2 - s) - 2*s/(0.5 + s)*c"], {"c": "0.05*c", "s": "0.05"}, ["c"],
                     [1e-3], [0.5, 1], [0.02, 0.04], 3.0, rows=16),
    "patches": system("x y", ["x*(1 - x)*(x - 0.2) + 0.1*(y - x)", "y*(1 - y)*(y - 0.2) + 0.1*(x - y)"],
                      {"x": "0.1*x", "y": "0.1*y"}, ["10*x + 10*y"], [1], [], [], 1.0, rows=16, domain=_POSITIVE,
                      observation_family="poisson", prior=_log_normal({"x": -0.5, "y": -0.5}, 0.3)),
    # three states
    "battery": system("soc v1 v2", ["-I/8280", "I/1500 - v1/30", "I/20000 - v2/600"], {"soc": "2e-5", "v1": "1e-4", "v2": "3e-5"},
                      [_CELL.format(" - v2")], [2.5e-5], [0.7, 0, 0], [0.02, 1e-4, 1e-4], 60.0, inputs=["I"],
                      inputs_at=_current),
    "sir": System({
        "state": ["s", "i", "b"], "drift": ["-exp(b)*s*i", "exp(b)*s*i - 0.2*i", "-0.1*(b - log(0.5))"],
        "diffusion": [["-0.1*s*i", "0"], ["0.1*s*i", "0"], ["0", "0.2"]], "observation": ["2000*i + 1"],
        "observation_kind": "samples", "observation_family": "negative-binomial", "dispersion": "0.02",
        "prior": {"kind": "gaussian", "mean": [0.95, 0.01, -0.7], "cov": [4e-4, 4e-6, 0.1]}}, 1.5),
    "re-entry": system("h v b", ["-v", "1 - b*v**2*exp(-h/3)/2", "0"], {"v": "0.05", "b": "0.01"}, ["sqrt(4 + (h - 1)**2)"],
                       [0.01],
                       [20, 4, 0.5], [0.25, 0.09, 0.04], 0.15),
    "lorenz-63": system("x y z", ["10*(y - x)", "x*(28 - z) - y", "x*y - 8*z/3"], {"x": "1", "y": "1", "z": "1"}, ["x"], [1],
                        [1, 1, 25], [4, 4, 4], 0.1),
    "robot": system("x y a", ["u*cos(a)", "u*sin(a)", "r"], {"x": "0.05", "y": "0.05", "a": "0.1"},
                    ["sqrt((x - 4)**2 + y**2)", "sqrt(x**2 + (y - 4)**2)"], [0.02, 0.02], [0, 0, 0.3], [0.3, 0.3, 0.5], 0.3,
                    periodic=["a"], inputs=["u", "r"], inputs_at=lambda t: [0.8 + 0.3 * np.sin(t), 0.5 * np.cos(0.4 * t)]),
    "chemostat": system("c s m", ["(m*s/(0.5 + s) - 0.3)*c", "0.3*(2 - s) - 2*m*s/(0.5 + s)*c", "0.2*(0.6 - m)"],
                        {"c": "0.05*c", "s": "0.02", "m": "0.05"}, ["c"], [4e-4], [0.4, 1, 0.6], [0.01, 0.05, 0.01], 0.7),
    "reactor": system("a b T", ["1 - a - exp(0.4*T)*a*b", "1 - b - exp(0.4*T)*a*b", "-2*T + 3*exp(0.4*T)*a*b"],
                      {"a": "0.05", "b": "0.05", "T": "0.2"}, ["T"], [0.01], [0.5, 0.5, 0.5], [0.04, 0.04, 0.1], 0.3),
    "neuron": system("v w c", ["3*(v - v**3/3 - w + c)", "(v + 0.7 - 0.8*w)/12", "0"], {"v": "0.2", "w": "0.03", "c": "0.02"},
                     ["exp(0.5 + v)"], [1], [-1, -0.5, 0.4], [0.2, 0.05, 0.05], 0.6, observation_family="poisson"),
    "track": system("x v a", ["v", "a", "-a"], {"a": "0.5"}, ["sqrt(1 + x**2)"], [1e-3], [3, -0.5, 0], [0.2, 0.1, 0.1], 0.3),
    "bursting": system("x y z", ["y - x**3 + 3*x**2 - z + 2", "1 - 5*x**2 - y", "0.01*(4*(x + 1.6) - z)"],
                       {"x": "0.2", "y": "0.2", "z": "0.02"}, ["x"], [0.05], [-1, -4, 1.8], [0.2, 1, 0.04], 0.5, rows=16),
    "lorenz-84": system("x y z", ["-y**2 - z**2 - 0.25*x + 2", "x*y - 4*x*z - y + 1", "4*x*y + x*z - z"],
                        {"x": "0.1", "y": "0.1", "z": "0.1"}, ["x", "y"], [0.05, 0.05], [1, 0, 0], [0.2] * 3, 0.2, rows=16),
    "glucose": system("g x i", ["-0.03*(g - 90) - x*g", "-0.02*x + 1e-5*(i - 10)", "-0.1*(i - 10) + 0.01*max(g - 100, 0)"],
                      {"g": "1", "x": "2e-4", "i": "0.5"}, ["g"], [25], [180, 1e-3, 20], [100, 1e-6, 25], 5.0, rows=16),
    # four to six
    "bearings": system("x y u v", ["u", "v", "0", "0"], {"u": "0.05", "v": "0.05"}, ["atan2(y - 3*sin(t/5), x - t + 4*sin(t/4))"],
                       [4e-4], [20, 12, 0, 0], [25, 25, 0.25, 0.25], 0.5),
    "radar": system("x y u v", ["u", "v", "0", "0"], {"u": "0.25", "v": "0.25"}, ["sqrt(x**2 + y**2)", "atan2(y, x)"],
                    [0.06, 0.003], [7, 5, -0.7, 0.2], [3, 3, 0.4, 0.4], 0.3),
    "oscillators": system("q u r w", _OSCILLATORS, {"u": "0.3", "w": "0.3"}, ["q + 0.3*r"], [0.04], [1, 0, -0.5, 0], [0.5] * 4,
                          0.4),
    "turn": system("x y u v w", ["u", "v", "-w*v", "w*u", "-0.05*w"], {"u": "0.2", "v": "0.2", "w": "0.05"},
                   ["sqrt(x**2 + y**2)", "atan2(y, x)"], [0.25, 4e-4], [-20, 5, 2, 0, 0.1], [4, 4, 0.5, 0.5, 0.02], 0.5),
    "lorenz-96": system("x0 x1 x2 x3 x4 x5", _L96, {f"x{i}": "1" for i in range(6)}, ["x0", "x1", "x3", "x4"], [0.5] * 4,
                        [2, 3, -1, 4, 2, 0], [4.0] * 6, 0.08),
}  # fmt: skip
