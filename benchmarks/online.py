"""The latency of one observation of an online filter, in process, after a warm-up.

    python benchmarks/online.py [--observations 20000] [--systems spiral kalman] [--watch]

The spiral sensor (one state, time-varying, a new filter every 1,000 observations) by the method that `auto` takes, and a
Kalman-Bucy filter of four states.  Linear algebra has one thread (OMP_NUM_THREADS=1), and the garbage of the warm-up is frozen
(`gc.freeze()`).  Percentiles in microseconds are printed as JSON; the first observation of a new filter is reported separately.
With `--watch` each tenth of the observations is printed too, with the memory of the process and the largest difference of the
mass of the density from one.  Expected: median at most 30, 99.9 % at most 1,000; memory constant within 5 %, time within 10 %.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import gc
import json
import resource
import time
from typing import Any

import numpy as np

import zakai

WARM = 2000
BATCH = 10_000
STEP = 0.01
LIFE = 1000  # observations after which the spiral starts again: its drift, t x / 40, takes the state from every sensor
OSCILLATORS = dict(
    state=["p", "v", "q", "w"],
    drift=["v", "-p - v/4 + q/2", "w", "-2*q - w/3 + p/2"],
    diffusion=[["1/10" if i == j else "0" for j in range(4)] for i in range(4)],
    observation=["p", "q"],
    observation_kind="increments",
    prior={"kind": "gaussian", "mean": [0.0] * 4, "cov": [1.0] * 4},
)


def system(name: str) -> zakai.Model:
    return zakai.load_model("gallery:spiral-sensor") if name == "spiral" else zakai.Model(**OSCILLATORS)


def increments(name: str, step: float, seed: int = 0):
    """Increments of a simulated path; the spiral's starts again after `LIFE` of them."""
    rng, k = np.random.default_rng(seed), 0
    x = np.zeros(4)
    while True:
        dv, dw = rng.standard_normal((BATCH, 4)) * np.sqrt(step), rng.standard_normal((BATCH, 2)) * np.sqrt(step)
        found = []
        for one, noise in zip(dv, dw, strict=True):
            k = k % LIFE + 1
            if name == "spiral":
                x = np.zeros(4) if k == 1 else x
                a = x[0] + (k * step / 40 * x[0]) * step + one[0]
                h, x = (a * np.sin(a), a * np.cos(a)), np.array([a])
            else:
                p, v, q, w = x
                x = x + np.array([v, -p - v / 4 + q / 2, w, -2 * q - w / 3 + p / 2]) * step + one / 10
                h = (x[0], x[2])
            found.append([h[0] * step + noise[0], h[1] * step + noise[1]])
        yield from found


def memory() -> float:
    """MiB that the process holds now."""
    with open("/proc/self/statm", encoding="ascii") as pages:
        return int(pages.read().split()[1]) * resource.getpagesize() / 2**20


def mass_error(online: Any) -> float:
    """How far the mass of the density is from one."""
    density = online.last.density
    weights = getattr(density, "weights", None)
    return abs(float(np.sum(weights)) - 1.0) if weights is not None else 0.0


def measure(name: str, count: int, watch: bool) -> dict[str, Any]:
    model, step, life = system(name), STEP, LIFE if name == "spiral" else count + WARM
    begin = time.perf_counter()
    online, source = zakai.online(model), increments(name, step)
    online.update(step, next(source))
    first = time.perf_counter() - begin
    # Filled and read once, so that the memory of this script is allocated before the first observation.
    elapsed, parts = np.full(count, 0.0), []
    np.median(elapsed[: count // 10 + 1])
    clock = time.perf_counter_ns
    for k in range(1, WARM + count):
        if k == WARM:
            gc.collect()
            gc.freeze()
        if k % life == 0:
            online = zakai.online(model)
        value, at = next(source), (k % life + 1) * step
        begun = clock()
        online.update(at, value)
        done = k - WARM
        if done < 0:
            continue
        elapsed[done] = clock() - begun
        if watch and (done + 1) % max(1, count // 10) == 0:
            part, mass = np.median(elapsed[done + 1 - count // 10 : done + 1]) / 1e3, mass_error(online)
            held = round(memory(), 1)
            parts.append({"median": round(float(part), 2), "MiB": held, "mass": mass})
    new = (np.arange(WARM, WARM + count) % life) == 0
    marks = np.percentile(elapsed[~new] / 1e3, [50, 90, 99, 99.9])
    found = {"method": online.method, "observations": count, "first_s": round(first, 2)}
    found |= {mark: round(float(value), 1) for mark, value in zip(("median", "90%", "99%", "99.9%"), marks, strict=True)}
    found |= {"new_filter": round(float(np.median(elapsed[new]) / 1e3), 1)} if new.any() else {}
    found |= {"largest": round(float(elapsed.max() / 1e3), 1), "estimate": online.last.mean.tolist()}
    return found | ({"tenths": parts} if watch else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--observations", type=int, default=20_000)
    parser.add_argument("--systems", nargs="+", choices=["spiral", "kalman"], default=["spiral", "kalman"])
    parser.add_argument("--watch", action="store_true")
    arguments = parser.parse_args()
    found = {name: measure(name, arguments.observations, arguments.watch) for name in arguments.systems}
    print(json.dumps({"microseconds": found}, indent=2))


if __name__ == "__main__":
    main()
