"""Run zakai simulate."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

from zakai.cli._files import check_outputs
from zakai.errors import InputError
from zakai.models.clock import clock


def simulate(
    source: str,
    until: float,
    step: float,
    seed: int,
    output: Path,
    truth_path: Path | None,
    initial: str,
    inputs_path: Path | None = None,
) -> None:
    """Simulate a record, and write it and the truth."""
    from zakai.models.files import load_model
    from zakai.records import read_inputs, write_record, write_truth
    from zakai.records.writing import shown
    from zakai.simulation.simulate import simulate

    check_outputs([output, truth_path], [source, inputs_path])
    model = load_model(source)
    times = clock(model.start, until, step)
    inputs = None
    if inputs_path is not None:
        inputs = read_inputs(inputs_path, model)
        inputs.check(model, float(times[0]), float(times[-1]), name=shown(inputs_path))
    start = _numbers(initial, model.state) if initial else None
    truth, record = simulate(model, times, seed=seed, initial=start, inputs=inputs)
    if truth_path is not None:
        write_truth(truth_path, truth, model.state)
    write_record(output, record, list(model.observation_names))
    print(f"{len(record):,} observation{'s' if len(record) > 1 else ''} written to {output}")


def _numbers(text: str, state: tuple[str, ...]) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(state) or not all(map(isfinite, values)):
        raise InputError(f'--initial "{text}": expected finite numbers for {", ".join(state)}, separated by commas')
    return values
