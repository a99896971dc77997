"""Random systems of two and three states: `tensor-train`, whose frame moves, against `yau-yau`, whose grid does not.

    python benchmarks/frame_gate.py [--states 2] [--count 20] [--first 0] [--methods yau-yau tensor-train] [--tolerance 1e-3]

Two states are drawn and judged by `random_plane.py` (sinc collocation on two grids), three by `random_space.py` with three runs
of a bootstrap filter.  A row has, for each method, the largest true error of a mean or a deviation in standard deviations, the
largest estimate of it, the largest ratio of both beyond the error of the judge, the largest error of a mean beyond it in
tolerances, and the time of an observation in a second call; ratio and tolerances until the method warns.  The promise is about
means: at most three tolerances, or a warning.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
import random_plane
import random_space
import several_states
from random_systems import difference

import zakai

JUDGES = 4  # standard errors of a judge that an error may have more
UNKNOWN = 1e-3  # error of a judge of two states above which a system is left out


class Case(NamedTuple):
    """A model, its record, and the judge: moments after each observation (K, 2 n + 1) and their error (K,)."""

    model: zakai.Model
    record: zakai.Record
    moments: np.ndarray
    error: np.ndarray


class Row(NamedTuple):
    """A method on a system: errors, the excess over what the estimate allows, the error of means in tolerances, milliseconds,
    the number of warnings, a refusal.
    """

    error: float
    estimate: float
    excess: float
    means: float
    took: float
    warned: int
    refusal: str


def case(states: int, seed: int, particles: int) -> Case:
    """Return a system with its judge, which is kept in a file."""
    if states == 2:
        model, _ = random_plane.system(seed)
        record = random_plane.record_of(model, seed)
    else:
        model, record = random_space.system(states, seed)
    path = Path(tempfile.gettempdir()) / f"frame-gate-{states}-{seed}-{particles if states > 2 else 0}.npz"
    if not path.exists():
        moments, error = plane(model, record) if states == 2 else sampled(model, record, particles)
        np.savez(path, moments=moments, error=error)
    known = np.load(path)
    return Case(model, record, known["moments"], known["error"])


def plane(model: zakai.Model, record: zakai.Record) -> tuple[np.ndarray, np.ndarray]:
    """Return the moments of two states and their error."""
    coarse, fine = (random_plane.reference(model, record, level) for level in (1e-8, 1e-11))
    return fine, difference(coarse, fine, model)


def sampled(model: zakai.Model, record: zakai.Record, particles: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the moments of three runs of particles and their error."""
    runs = []
    for seed in range(3):
        mean, cov, _ = several_states.bootstrap(model, record, particles, 10 + seed)
        runs.append(np.column_stack([mean, np.einsum("kii->ki", cov), np.zeros(len(mean))]))
    together = np.mean(runs, axis=0)
    return together, JUDGES * np.max([difference(run, together, model) for run in runs], axis=0) / np.sqrt(2)


def measured(found: Case, method: str, tolerance: float) -> Row:
    """Return the figures of a method."""
    model, record = found.model, found.record
    took = []
    for _ in range(3):
        begin = time.process_time()
        try:
            result = zakai.filter(model, record, method, tolerance=tolerance, keep="moments")
        except zakai.ZakaiError as refusal:
            return Row(np.nan, np.nan, np.nan, np.nan, np.nan, 0, str(refusal)[:200])
        took.append(1e3 * (time.process_time() - begin) / len(record.times))
    moments = np.column_stack([result.mean[1:], result.variance[1:], result.log_likelihood_increments[1:]])
    error, estimate = difference(moments, found.moments, model), np.asarray(result.error_estimate[1:])
    late = np.any([result.health[key][1:] > bound for key, (bound, _) in result.bounds.items()], axis=0)
    silent, n = ~np.maximum.accumulate(late), model.n
    excess = np.where(silent, np.maximum(error - found.error, 0.0) / np.maximum(estimate, 1e-12), 0.0)
    of_means = difference(np.column_stack([moments[:, :n], found.moments[:, n:]]), found.moments, model)
    means = np.where(silent, np.maximum(of_means - found.error, 0.0) / tolerance, 0.0)
    return Row(error.max(), estimate.max(), excess.max(), means.max(), min(took[1:]), int(late.sum()), "")


def main() -> None:
    """Print a table and its sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=2, choices=[2, 3])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--methods", nargs="*", default=["yau-yau", "tensor-train"])
    parser.add_argument("--tolerance", type=float, default=1e-3)
    parser.add_argument("--particles", type=int, default=300_000)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows: dict[str, list[Row]] = {method: [] for method in args.methods}
    seed = args.first
    while len(rows[args.methods[0]]) < args.count:
        found = case(args.states, seed, args.particles)
        if args.states > 2 or found.error.max() < UNKNOWN:
            kind = f"{found.record.kind}, h = {', '.join(map(str, found.model.observation))}"
            print(f"{seed} judge {found.error.max():.0e}, {kind}")
            for method in args.methods:
                row = measured(found, method, args.tolerance)
                rows[method].append(row)
                figures = f"{row.took:8.2f} ms, error {row.error:.1e}, estimate {row.estimate:.1e}, ratio {row.excess:.2g}"
                figures += f", means {row.means:.2f} tolerances"
                print(f"  {method:14}{row.refusal or figures}{f', {row.warned} warn' if row.warned else ''}", flush=True)
        seed += 1
    first = np.array([row.took for row in rows[args.methods[0]]])
    for method, own in rows.items():
        error, took = np.array([row.error for row in own]), np.array([row.took for row in own])
        refused, warned = sum(bool(row.refusal) for row in own), sum(row.warned > 0 for row in own)
        print(f"{method}: {refused} refused, {warned} warned, {sum(row.means > 3 for row in own)} silent above three tolerances")
        print(f"  {sum(row.excess > 3 for row in own)} above three estimates")
        print(f"  error median {np.nanmedian(error):.1e}, largest {np.nanmax(error):.1e}; {np.nanmedian(took):.1f} ms")
        ratio = took / first
        print(f"  time over {args.methods[0]}: median {np.nanmedian(ratio):.2f}, from {ratio.min():.2f} to {ratio.max():.2f}")


if __name__ == "__main__":
    main()
