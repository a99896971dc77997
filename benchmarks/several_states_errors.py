"""Systems of three to six states: the true error of `tensor-train` at its default tolerance, and its estimate.

    python benchmarks/several_states_errors.py [NAME ...] [--finer 16] [--most-rank 60] [--seconds 120]

The systems are those of `choices_systems.py`, and of `several_states.py` with a + after their names.  The judge is the same
method at a tolerance that is `finer` times smaller, with larger ranks, and again at half of that factor; both are kept in a file.
The judge is lost from the first time on at which the means of the two differ by more than a tolerance, the finer one warns, or
its seconds are used up; nothing is known of later times.  Errors are the largest over the times that are known, in standard
deviations.  The promise is about means: at most three tolerances, or a warning.  An error is silent where it is larger by more
than the difference of the two.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
import several_states
from choices_systems import SYSTEMS
from random_systems import difference

import zakai
from zakai.methods.frame.tensor_train import FEW_STATES, TOLERANCES

HEAD = "system, n: errors of means, of means and deviations, of the judge; of means in tolerances; estimate / error; warned; ms"


def problems() -> Iterator[tuple[str, zakai.Model, zakai.Record]]:
    """Yield the name, the model and the record of each system."""
    for name, system in SYSTEMS.items():
        if 3 <= len(system.keys["state"]) <= 6:
            yield name, *system.problem()
    for name, made in several_states.SYSTEMS.items():
        model, times = made()
        yield f"{name}+", model, zakai.simulate(model, times, seed=5)[1]


def moments(result: zakai.Result) -> np.ndarray:
    """Return means and variances after each observation (K, 2 n)."""
    return np.column_stack([result.mean[1:], result.variance[1:]])


class Judge(NamedTuple):
    """Moments after the first observations (J, 2 n), and by how much the means of a coarser judge differ, in deviations (J,)."""

    moments: np.ndarray
    doubt: np.ndarray


def run(model: zakai.Model, record: zakai.Record, seconds: float, tolerance: float, most_rank: int) -> np.ndarray:
    """Return the moments (J, 2 n) of `tensor-train` until it warns or its seconds are used up."""
    found, end = list[np.ndarray](), time.process_time() + seconds
    online = zakai.online(model, "tensor-train", inputs=record.inputs, tolerance=tolerance, most_rank=most_rank)
    for at, values in zip(record.times, record.values, strict=True):
        estimate = online.update(at, values)
        if estimate.warnings or time.process_time() > end:
            break
        found.append(np.concatenate([estimate.mean, np.diag(estimate.cov)]))
    return np.reshape(found, (-1, 2 * model.n))


def judged(name: str, model: zakai.Model, record: zakai.Record, args: argparse.Namespace) -> Judge:
    """Return the judge of a system, until it is lost."""
    allowed, n = TOLERANCES[model.n > FEW_STATES], model.n
    path = Path(tempfile.gettempdir()) / f"several-states-judge-{name}-{args.finer:g}-{args.most_rank}-{args.seconds:g}.npz"
    if not path.exists():
        one, other = (run(model, record, args.seconds, allowed / finer, args.most_rank) for finer in (args.finer, args.finer / 2))
        np.savez(path, one=one, other=other)
    kept = np.load(path)
    count = min(len(kept["one"]), len(kept["other"]))
    one, other = kept["one"][:count], kept["other"][:count]
    doubt = difference(np.column_stack([other[:, :n], one[:, n:]]), one, model)
    lost = ~(doubt <= allowed)
    count = int(np.argmax(lost)) if lost.any() else count
    return Judge(one[:count], doubt[:count])


class Row(NamedTuple):
    """The errors of means, and of means and deviations, without that of the judge (J,), estimates (J,), warned (J,), and ms."""

    means: np.ndarray
    both: np.ndarray
    estimate: np.ndarray
    warned: np.ndarray
    took: float


def measured(model: zakai.Model, record: zakai.Record, judge: Judge) -> Row:
    """Return the errors of the default tolerance until the judge is lost."""
    zakai.filter(model, record, "tensor-train", keep="moments")  # which reads the kernels
    begin = time.process_time()
    result = zakai.filter(model, record, "tensor-train", keep="moments")
    took = 1e3 * (time.process_time() - begin) / len(record.times)
    known, n = judge.moments, model.n
    found = moments(result)[: len(known)]
    both, means = difference(found, known, model), difference(np.column_stack([found[:, :n], known[:, n:]]), known, model)
    warned = np.any([result.health[key][1:] > bound for key, (bound, _) in result.bounds.items()], axis=0)[: len(known)]
    both, means = (np.where(np.isnan(error), np.inf, error) for error in (both, means))
    return Row(means, both, result.error_estimate[1 : len(known) + 1], np.maximum.accumulate(warned), took)


def main() -> None:
    """Print a row for each system and a sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--finer", type=float, default=16.0)
    parser.add_argument("--most-rank", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=120.0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print(HEAD)
    silent, lost, ratios = [], [], []
    for name, model, record in problems():
        if args.names and name not in args.names:
            continue
        judge, tolerance = judged(name, model, record, args), TOLERANCES[model.n > FEW_STATES]
        known = len(judge.doubt)
        if known < len(record.times):
            lost.append(name)
        if not known:
            print(f"{name:12} {model.n}: the judge is lost from the first row on", flush=True)
            continue
        row = measured(model, record, judge)
        ratios.append(float(row.estimate.max() / row.both.max()))
        if (row.means[~row.warned] > 3 * tolerance + judge.doubt[~row.warned]).any():
            silent.append(name)
        words = f"{name:12} {model.n}: {row.means.max():.1e} {row.both.max():.1e} {judge.doubt.max():.0e}"
        words += f" {row.means.max() / tolerance:6.2f} {ratios[-1]:6.2f}  "
        words += f"{f'from row {np.argmax(row.warned)}' if row.warned.any() else 'no':11} {row.took:5.0f}"
        words += f", judge lost from row {known} of {len(record.times)}" if known < len(record.times) else ""
        print(f"{words}{' SILENT' if name in silent else ''}", flush=True)
    print(f"{len(ratios)} systems; silent above three tolerances: {', '.join(silent) or 'none'}")
    print(f"the judge is lost in {', '.join(lost) or 'none'}")
    logs = np.log([ratio for ratio in ratios if 0 < ratio < np.inf])
    if len(logs):
        least, mean, most = np.exp([logs.min(), logs.mean(), logs.max()])
        print(f"estimate over error: {mean:.2f} in the mean, from {least:.2f} to {most:.2f}")


if __name__ == "__main__":
    main()
