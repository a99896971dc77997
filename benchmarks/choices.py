"""What `auto` takes for systems of two to six states, how long that runs, and how far its means are from those of many particles.

    python benchmarks/choices.py [NAME ...] [--methods auto yau-yau] [--limit 60] [--judge 100000]
    python benchmarks/choices.py [NAME ...] --fit

Each line is one system and one method in a process of its own with a limit of processor seconds: the method that ran, its seconds
with the loading of kernels, the root mean square of the errors of means in posterior standard deviations, the difference of the
log-likelihood, and the warnings.  The judge is the mean of two runs of `guided-particles` with many particles and other seeds,
kept in the folder for temporary files; `judge` is half of their distance.

With `--fit` the constants of `zakai/algebra/expected_work.py` are compared with what is measured: seconds of an observation,
kernels loaded, over the expected ones, and of tensor trains over the work by the ranks and substeps of the run.  The medians are
printed last: POINT, PARTICLE and MARGIN are to be multiplied by those of `expected`, and PRODUCT by that of `by steps`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from choices_systems import SYSTEMS, System

import zakai
from zakai.algebra.conditions import all_hold
from zakai.algebra.expected_work import expected_work, work_of_step
from zakai.algebra.order import GENERAL
from zakai.algebra.theorems import conditions_of


def apart(model: zakai.Model, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a - b, that of angles wrapped."""
    found = a - b
    for i, name in enumerate(model.state):
        if name in model.periodic:
            found[..., i] = (found[..., i] + np.pi) % (2 * np.pi) - np.pi
    return found


def rms(values: np.ndarray) -> float:
    """Return the root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))


def judged(name: str, model: zakai.Model, record: zakai.Record, particles: int) -> dict[str, Any]:
    """Return means, deviations and the log-likelihood by many particles, kept in a file."""
    key = hashlib.sha256(record.values.tobytes()).hexdigest()[:8]
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"choices-{name}-{particles}-{key}.npz"
    if not path.exists():
        one, two = (
            zakai.filter(model, record, "guided-particles", particles=particles, seed=1000 + i, keep="moments") for i in (0, 1)
        )
        difference = apart(model, two.mean, one.mean)
        sd = np.sqrt(0.5 * (one.variance + two.variance))
        logs = one.log_likelihood, two.log_likelihood
        np.savez(path, mean=one.mean + 0.5 * difference, sd=sd, judge=rms(0.5 * (difference / sd)[1:]), logs=logs)
    return dict(np.load(path))


def row(name: str, system: System, method: str, judge: int) -> str:
    """Return the line of one system and one method."""
    model, record = system.problem()
    known = judged(name, model, record, judge) if judge else {}
    model = zakai.Model(**system.keys)
    started = time.process_time()
    result = zakai.filter(model, record, method, keep="moments")
    took = time.process_time() - started
    words = f"{name:12} n={model.n} {method:16} {result.method:24} {took:7.2f} s"
    if judge:
        error = rms((apart(model, result.mean, known["mean"]) / known["sd"])[1:])
        logs = result.log_likelihood - known["logs"].mean()
        words += f"  error {error:.3f} (judge {float(known['judge']):.3f})  log {logs:+.2f}"
    return f"{words}  warnings {len(result.warnings)}" + "".join(f"\n      {one[:160]}" for one in result.warnings)


def ratios(name: str, system: System, method: str) -> str:
    """Return the seconds of an observation over the expected ones, and over those by the health figures of the steps."""
    model, record = system.problem()
    work = expected_work(method, model, None)
    if work is None or all_hold(conditions_of(method, model)) is not True:
        return f"{name:12} {method:16} is not compared"
    zakai.filter(zakai.Model(**system.keys), record, method, keep="moments")
    model = zakai.Model(**system.keys)
    started = time.process_time()
    result = zakai.filter(model, record, method, keep="moments")
    seconds = (time.process_time() - started) / len(record)
    words = f"{name:12} {method:16} {seconds:.4f} s  expected {seconds / work.seconds:.2f}"
    steps = [{key: float(figures[k]) for key, figures in result.health.items()} for k in range(1, len(record) + 1)]
    found = [work_of_step(method, model, step) for step in steps]
    if None not in found:
        words += f"  by steps {seconds / np.mean([one.seconds for one in found]):.2f}"
    return words


def fit(names: list[str], limit: int) -> None:
    """Print the ratios of all systems and their medians."""
    found: dict[tuple[str, str], list[float]] = {}
    for name in names:
        for method in GENERAL:
            said = limited([sys.executable, __file__, "--one", f"{name}:{method}", "--fit"], limit)
            print(said if said.startswith(name) else f"{name:12} {method:16} {said}", flush=True)
            for what, value in re.findall(r"(expected|by steps) ([0-9.]+)", said):
                found.setdefault((method, what), []).append(float(value))
    for (method, what), values in found.items():
        print(f"{method:16} {what:9} median {np.median(values):.2f} of {len(values)}, {min(values):.2f} to {max(values):.2f}")


def limited(command: list[str], seconds: int) -> str:
    """Return what a process prints, or that it ran into its limit of processor seconds."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 2))

    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit, check=False)
    if done.returncode == 0:
        return done.stdout.rstrip()
    last = (done.stderr.strip().splitlines() or [""])[-1]
    return f"more than {seconds} s" if done.returncode < 0 else f"{last[:300]}"


def main() -> None:
    """Print a line for each system and method."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*")
    parser.add_argument("--methods", nargs="*", default=["auto"])
    parser.add_argument("--limit", type=int, default=60)
    parser.add_argument("--judge", type=int, default=100_000)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--one", help="NAME:METHOD of one line, in this process")
    args = parser.parse_args()
    if args.one:
        name, method = args.one.split(":")
        print(ratios(name, SYSTEMS[name], method) if args.fit else row(name, SYSTEMS[name], method, args.judge))
        return
    if args.fit:
        fit(args.names or list(SYSTEMS), args.limit)
        return
    for name in args.names or SYSTEMS:
        for method in args.methods:
            command = [sys.executable, __file__, "--one", f"{name}:{method}", "--judge", str(args.judge)]
            said = limited(command, args.limit)
            print(said if said.startswith(name) else f"{name:12} {method:16} {said}", flush=True)


if __name__ == "__main__":
    main()
