"""zakai simulate"""

from __future__ import annotations

from decimal import Decimal
from math import isfinite
from pathlib import Path

import numpy as np

from zakai.cli._files import check_outputs
from zakai.errors import InputError

MOST_OBSERVATIONS = 10_000_000


def simulate(
    source: str, until: float, step: float, seed: int, output: Path, truth_path: Path | None, initial: str
) -> None:
    """Simulate a record, and write it and the truth."""
    from zakai.models.files import load_model
    from zakai.models.simulate import simulate
    from zakai.records import write_record, write_truth

    check_outputs([output, truth_path], [source])
    model = load_model(source)
    times = clock(model.start, until, step)
    truth, record = simulate(model, times, seed=seed, initial=_numbers(initial, model.state) if initial else None)
    if truth_path is not None:
        write_truth(truth_path, truth, model.state)
    write_record(output, record)
    print(f"{len(record):,} observation{'s' if len(record) > 1 else ''} written to {output}")


def clock(start: float, until: float, step: float) -> np.ndarray:
    """start + step, start + 2 step, ... up to `until`, as decimals rather than as sums of rounded numbers."""
    if not (isfinite(step) and step > 0):
        raise InputError(f"--step {step:g}: must be a positive number")
    if not (isfinite(until) and until > start):
        raise InputError(f"--until {until:g}: must be after the model's start, {start:g}")
    count = (until - start) / step * (1 + 1e-12)
    if count < 1:
        raise InputError(f"--step {step:g}: leaves no observation between the start {start:g} and --until {until:g}")
    if count > MOST_OBSERVATIONS:
        raise InputError(f"--step {step:g}: gives {count:.3g} observations; at most {MOST_OBSERVATIONS:,} are simulated at once")
    digits = max(-int(Decimal(repr(number)).as_tuple().exponent) for number in (start, step))
    times = start + step * np.arange(1, int(count) + 1)
    return np.round(times, digits) if 0 < digits < 12 else times


def _numbers(text: str, state: tuple[str, ...]) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(state) or not all(map(isfinite, values)):
        raise InputError(f'--initial "{text}": expected finite numbers for {", ".join(state)}, separated by commas')
    return values
