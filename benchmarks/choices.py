"""What `auto` takes for systems of two to six states, how long that runs, and how far its means are from those of many particles.

    python benchmarks/choices.py [NAME ...] [--methods auto yau-yau] [--limit 60] [--judge 100000]

Each line is one system and one method in a process of its own with a limit of processor seconds: the method that ran, its seconds
with the loading of kernels, the root mean square of the errors of means in posterior standard deviations, the difference of the
log-likelihood, and the warnings.  The judge is the mean of two runs of `guided-particles` with many particles and other seeds,
kept in the folder for temporary files; `judge` is half of their distance.
"""

from __future__ import annotations

import argparse
import os
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
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"choices-{name}-{particles}.npz"
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
    parser.add_argument("--one", help="NAME:METHOD of one line, in this process")
    args = parser.parse_args()
    if args.one:
        name, method = args.one.split(":")
        print(row(name, SYSTEMS[name], method, args.judge))
        return
    for name in args.names or SYSTEMS:
        for method in args.methods:
            command = [sys.executable, __file__, "--one", f"{name}:{method}", "--judge", str(args.judge)]
            said = limited(command, args.limit)
            print(said if said.startswith(name) else f"{name:12} {method:16} {said}", flush=True)


if __name__ == "__main__":
    main()
