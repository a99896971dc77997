"""Systems of three to six states: the true error of `tensor-train` at its default tolerance, and its estimate.

    python benchmarks/several_states_errors.py [NAME ...] [--finer 16] [--most-rank 60]

The systems are those of `choices_systems.py`, and of `several_states.py` with a + after their names.  The judge is the same
method at a tolerance that is `finer` times smaller, with larger ranks; it is kept in a file, ! says that it warns.  Errors are
the largest over all times, in standard deviations.  The promise is about means: at most three tolerances, or a warning.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
import several_states
from choices_systems import SYSTEMS
from random_systems import difference

import zakai
from zakai.methods.frame.tensor_train import FEW_STATES, TOLERANCES

HEAD = "system, n: error of means, of means and deviations, of the judge; of means in tolerances; estimate / error; warned; ms"


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


def judged(name: str, model: zakai.Model, record: zakai.Record, finer: float, most_rank: int) -> tuple[np.ndarray, float, bool]:
    """Return the moments of a finer run, its estimated error, and whether it warned."""
    path = Path(tempfile.gettempdir()) / f"several-states-errors-{name}-{finer:g}-{most_rank}.npz"
    if not path.exists():
        options = {"tolerance": TOLERANCES[model.n > FEW_STATES] / finer, "most_rank": most_rank}
        result = zakai.filter(model, record, "tensor-train", keep="moments", **options)
        np.savez(path, moments=moments(result), estimate=result.error_estimate[1:].max(), warned=len(result.warnings) > 0)
    found = np.load(path)
    return found["moments"], float(found["estimate"]), bool(found["warned"])


def main() -> None:
    """Print a row for each system and a sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--finer", type=float, default=16.0)
    parser.add_argument("--most-rank", type=int, default=60)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print(HEAD)
    silent, ratios = [], []
    for name, model, record in problems():
        if args.names and name not in args.names:
            continue
        known, doubt, doubted = judged(name, model, record, args.finer, args.most_rank)
        zakai.filter(model, record, "tensor-train", keep="moments")  # which reads the kernels
        begin = time.process_time()
        result = zakai.filter(model, record, "tensor-train", keep="moments")
        took = 1e3 * (time.process_time() - begin) / len(record.times)
        found, tolerance, n = moments(result), TOLERANCES[model.n > FEW_STATES], model.n
        both, means = difference(found, known, model), difference(np.column_stack([found[:, :n], known[:, n:]]), known, model)
        late = np.any([result.health[key][1:] > bound for key, (bound, _) in result.bounds.items()], axis=0)
        late = np.maximum.accumulate(late | ~np.isfinite(both))
        ratios.append(float(result.error_estimate[1:].max() / both.max()))
        if (means[~late] > 3 * tolerance).any():
            silent.append(name)
        words = f"{name:12} {n}: {means.max():.1e} {both.max():.1e} {doubt:.0e}{'!' if doubted else ' '}"
        words += f" {means.max() / tolerance:6.2f} {ratios[-1]:6.2f}  {f'from row {np.argmax(late)}' if late.any() else 'no':11}"
        print(f"{words} {took:5.0f}{' SILENT' if name in silent else ''}", flush=True)
    logs = np.log([ratio for ratio in ratios if np.isfinite(ratio)])
    print(f"{len(ratios)} systems; silent above three tolerances: {', '.join(silent) or 'none'}")
    least, mean, most = np.exp([logs.min(), logs.mean(), logs.max()])
    print(f"estimate over error: {mean:.2f} in the mean, from {least:.2f} to {most:.2f}")


if __name__ == "__main__":
    main()
