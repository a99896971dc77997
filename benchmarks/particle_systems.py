"""Systems of two to eight states on which particles are measured.

When the past is moved was chosen on bearings, turn, predator, volatility, robot and pendulums; the smallest number of particles
also on the reactor.  The others took no part in any choice.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import zakai


def _model(state: str, drift: list[str], noise: dict[str, str], observation: list[str], variances: list[float], mean: list[float],
           cov: list[float], **more: object) -> zakai.Model:  # fmt: skip
    """Return a model whose states of `noise` have independent noise with these factors."""
    names = state.split()
    rows = [[noise[name] if name == other else "0" for other in noise] for name in names]
    keys = {"observation_kind": "samples", "observation_noise": np.diag(variances).tolist()} | more
    return zakai.Model(
        state=names, drift=drift, diffusion=rows, observation=observation, prior={"kind": "gaussian", "mean": mean, "cov": cov},
        **keys
    )


def bearings() -> zakai.Model:
    """A target on a nearly straight course, seen as a bearing from a platform that turns."""
    own = "(t - 4*sin(t/4)), (3*sin(t/5))".split(", ")
    return _model("x y u v", ["u", "v", "0", "0"], {"u": "0.05", "v": "0.05"}, [f"atan2(y - {own[1]}, x - {own[0]})"], [4e-4],
                  [20, 12, 0, 0], [25, 25, 0.25, 0.25])  # fmt: skip


def turn() -> zakai.Model:
    """A coordinated turn with an unknown rate, seen as range and bearing."""
    return _model("x y u v w", ["u", "v", "-w*v", "w*u", "0"], {"u": "0.3", "v": "0.3", "w": "0.02"},
                  ["sqrt(x**2 + y**2)", "atan2(y, x)"], [1.0, 4e-4], [60, 30, -3, 2, 0.05], [16, 16, 1, 1, 0.01])  # fmt: skip


def falling() -> zakai.Model:
    """A body that falls through the atmosphere with an unknown ballistic coefficient, seen by its distance."""
    return _model("h s b", ["-s", "9.81 - exp(-h/7000)*s**2*exp(b)*2e-4", "0"], {"s": "2", "b": "0.02"},
                  ["sqrt(h**2 + 3e7)/10"], [9.0], [24000, 1200, 0], [4e4, 1e4, 0.25])  # fmt: skip


def chain() -> zakai.Model:
    """Three coupled oscillators with cubic springs and noise in the velocities alone."""
    force = ["y - 2*x - x**3", "x + z - 2*y - y**3", "y - 2*z - z**3"]
    drift = ["u", "v", "w", *(f"{one} - 0.2*{speed}" for one, speed in zip(force, "uvw"))]
    return _model("x y z u v w", drift, dict.fromkeys("uvw", "0.4"), ["x + z", "y**2"], [0.01, 0.01], [0.8, 0, -0.5, 0, 0.5, 0],
                  [0.25] * 6)  # fmt: skip


def lorenz_96() -> zakai.Model:
    """Six variables of Lorenz, four of them seen."""
    n = 6
    drift = [f"(x{(i + 1) % n} - x{(i - 2) % n})*x{(i - 1) % n} - x{i} + 8" for i in range(n)]
    names = [f"x{i}" for i in range(n)]
    return _model(" ".join(names), drift, dict.fromkeys(names, "1"), ["x0", "x1", "x3", "x4"], [0.5] * 4, [2, 3, -1, 4, 2, 0],
                  [4.0] * n)  # fmt: skip


def car() -> zakai.Model:
    """A car on a hilly road: position and speed from the height of the road."""
    return _model("p v", ["v", "-0.8*cos(p/2) - 0.1*v*abs(v) + 1"], {"v": "0.5"}, ["4*sin(p/2) + p/10"], [0.09], [0, 2], [4, 0.5])


def epidemic() -> zakai.Model:
    """Susceptible and infected shares of a population, with noise that depends on them; infections are counted."""
    return _model("s i", ["-0.9*s*i", "0.9*s*i - 0.3*i"], {"s": "0", "i": "0.15*i"}, ["1000*i"], [1.0],
                  [0.95, 0.02], [4e-4, 1.6e-5], observation_family="poisson",
                  domain={"s": {"lower": 0.0}, "i": {"lower": 0.0}})  # fmt: skip


def robot() -> zakai.Model:
    """A robot on a circle around two beacons, with its heading as an angle."""
    return _model("x y a", ["cos(a)", "sin(a)", "0.3"], {"x": "0.05", "y": "0.05", "a": "0.15"},
                  ["sqrt((x - 4)**2 + y**2)", "sqrt(x**2 + (y - 5)**2)"], [0.04, 0.04], [0, 0, 0], [1, 1, 0.5], periodic=["a"])
                  # fmt: skip


def volatility() -> zakai.Model:
    """Two factors of a volatility, of which returns are seen."""
    return _model("a b", ["-0.05*a", "-2*b"], {"a": "0.2", "b": "0.8"}, ["0"], [1.0], [0, 0], [0.4, 0.16],
                  observation_noise=[["exp(a + b)"]])  # fmt: skip


def predator() -> zakai.Model:
    """Logarithms of two populations, with heavy-tailed observations."""
    return _model("a b", ["0.8 - 0.5*exp(b)", "0.4*exp(a) - 0.6"], {"a": "0.15", "b": "0.15"}, ["exp(a)", "exp(b)"], [0.04, 0.04],
                  [0.3, 0.2], [0.1, 0.1], observation_family="student-t", degrees_of_freedom="4")  # fmt: skip


def pendulums() -> zakai.Model:
    """Two coupled pendulums, seen in continuous time."""
    drift = ["u", "v", "-2*sin(a) - 0.5*sin(a - b) - 0.1*u", "-2*sin(b) + 0.5*sin(a - b) - 0.1*v"]
    return _model("a b u v", drift, {"u": "0.5", "v": "0.5"}, ["sin(a)", "cos(b)"], [0.02, 0.02], [0.5, -0.5, 0, 0], [1.0] * 4,
                  observation_kind="increments")  # fmt: skip


def reactor() -> zakai.Model:
    """Two reactants and a temperature, of which the temperature is seen."""
    rate = "exp(0.4*T)*a*b"
    return _model("a b T", [f"1 - a - {rate}", f"1 - b - {rate}", f"-2*T + 3*{rate}"], {"a": "0.05", "b": "0.05", "T": "0.2"},
                  ["T"], [0.01], [0.5, 0.5, 0.5], [0.04, 0.04, 0.1])  # fmt: skip


def chain_8() -> zakai.Model:
    """Four oscillators in a row, the ends of which are seen."""
    names = [f"x{i}" for i in range(4)] + [f"v{i}" for i in range(4)]
    drift = [f"v{i}" for i in range(4)]
    for i in range(4):
        sides = [f"x{j} - x{i}" for j in (i - 1, i + 1) if 0 <= j < 4]
        drift.append(f"{' + '.join(sides)} - x{i} - 0.3*x{i}**3 - 0.2*v{i}")
    return _model(" ".join(names), drift, {f"v{i}": "0.4" for i in range(4)}, ["x0", "sin(x3)"], [0.02, 0.02],
                  [0.5] * 4 + [0.0] * 4, [0.2] * 8)  # fmt: skip


# The model, the mean length of an interval, and Euler's steps of the bootstrap filter in it.
SYSTEMS: dict[str, tuple[Callable[[], zakai.Model], float, int]] = {
    "bearings": (bearings, 0.5, 2),
    "turn": (turn, 0.5, 4),
    "falling": (falling, 0.5, 4),
    "chain": (chain, 0.3, 8),
    "chain_8": (chain_8, 0.4, 8),
    "lorenz_96": (lorenz_96, 0.08, 6),
    "car": (car, 0.3, 4),
    "epidemic": (epidemic, 0.5, 10),
    "robot": (robot, 0.3, 3),
    "volatility": (volatility, 0.5, 4),
    "predator": (predator, 0.5, 5),
    "pendulums": (pendulums, 0.1, 5),
    "reactor": (reactor, 0.3, 6),
}


def problem(name: str, count: int = 40, seed: int = 0) -> tuple[zakai.Model, zakai.Record]:
    """Return a model and a record at irregular times with gaps."""
    make, length, _ = SYSTEMS[name]
    model = make()
    rng = np.random.default_rng(seed + 17)
    times = np.cumsum(length * rng.uniform(0.6, 1.4, count))
    _, record = zakai.simulate(model, times, seed=seed, substeps=50)
    values = record.values.copy()
    values[rng.integers(5, count, 2)] = np.nan
    return model, zakai.Record(times, values, record.kind)


def bootstrap(
    model: zakai.Model, record: zakai.Record, count: int, seed: int, steps: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return means and deviations (K, n) and the log-likelihood of a plain bootstrap filter in NumPy."""
    from zakai.models.numeric import numpy_function

    rng, theta = np.random.default_rng(seed), model.theta()
    f, g, h = (numpy_function(part, model, shape) for part, shape in (
        (model.drift, (model.n,)), (model.diffusion, model.diffusion.shape), (model.observation, (model.m,))))  # fmt: skip
    S = np.diag(np.array(model.observation_noise.subs(dict(zip(model.x, model.prior.mean))), float))
    root = np.linalg.cholesky(np.array(model.process_noise, float))
    constant = not model.diffusion.free_symbols & set(model.x)
    G = g(np.zeros(model.n), 0.0, theta) @ root if constant else None
    x = model.prior.mean + rng.standard_normal((count, model.n)) @ np.linalg.cholesky(model.prior.cov).T
    weights, t, total = np.full(count, 1.0 / count), float(model.start), 0.0
    angles = np.array([name in model.periodic for name in model.state])
    means, deviations = [], []
    sampled = model.observation_kind == "samples"
    for stop, z in zip(record.times, record.values):
        number = max(1, round(steps * (stop - t) / np.median(np.diff(record.times))))
        d, logs = (stop - t) / number, np.zeros(count)
        seen = ~np.isnan(z)
        for j in range(number):
            at = t + j * d
            if not sampled:
                own = h(x, at, theta)[:, seen]
                logs += 0.5 * (own @ (z[seen] / S[seen]) / number - 0.5 * d * (own**2 / S[seen]).sum(1))
            middle = x + 0.5 * d * f(x, at, theta)
            noise = rng.standard_normal((count, root.shape[0])) * np.sqrt(d)
            if G is not None:
                kick = noise @ G.T
                x = x + d * f(middle + 0.5 * kick, at + 0.5 * d, theta) + kick
            else:
                x = x + d * f(middle, at + 0.5 * d, theta) + np.einsum("pij,pj->pi", g(x, at, theta) @ root, noise)
            for place, name in enumerate(model.state):
                if name in model.domain:
                    x[:, place] = model.domain[name].reflected(x[:, place])
            if not sampled:
                own = h(x, at + d, theta)[:, seen]
                logs += 0.5 * (own @ (z[seen] / S[seen]) / number - 0.5 * d * (own**2 / S[seen]).sum(1))
        t = stop
        if sampled and seen.any():
            logs = model.observation_law.log_density(z, x, t, theta)
            wrapped = [str(part).startswith("atan2") for part in model.observation]
            if any(wrapped):
                r = z - h(x, t, theta)
                r = np.where(wrapped, r - 2 * np.pi * np.round(r / (2 * np.pi)), r)
                logs = -0.5 * (r[:, seen] ** 2 / S[seen] + np.log(2 * np.pi * S[seen])).sum(1)
        logs = np.where(np.isfinite(x).all(axis=1) & ~np.isnan(logs), logs, -np.inf)
        x[~np.isfinite(logs)] = x[np.argmax(logs)]
        top = logs.max()
        weights = weights * np.exp(logs - top)
        total += np.log(weights.sum()) + top
        weights /= weights.sum()
        mean = weights @ x
        mean[angles] = np.angle(weights @ np.exp(1j * x[:, angles]))
        apart = x - mean
        apart[:, angles] -= 2 * np.pi * np.round(apart[:, angles] / (2 * np.pi))
        means.append(mean)
        deviations.append(np.sqrt(weights @ apart**2))
        if 1.0 / (weights**2).sum() < 0.5 * count:
            places = np.searchsorted(np.cumsum(weights), (rng.random() + np.arange(count)) / count).clip(0, count - 1)
            x, weights = x[places], np.full(count, 1.0 / count)
    return np.array(means), np.array(deviations), total
