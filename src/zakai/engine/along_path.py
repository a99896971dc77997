"""A record whose observations stand in formulas, as one with the observed path among the inputs: for the notes of a result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from zakai.models.features import OBSERVED_PATH
from zakai.models.model import Model
from zakai.models.observed_path import with_path_as_inputs
from zakai.records import Record
from zakai.records.path_inputs import PathInputs
from zakai.records.schedule import Schedule


def along_path(model: Model, schedule: Schedule, values: np.ndarray, start: np.ndarray | None = None) -> tuple[Model, Schedule]:
    """Return a model and a schedule whose inputs contain the path; the same where no formula contains it.

    Args:
        model: The model.
        schedule: K intervals, one after the other.
        values: The increments (K, m).
        start: The path (m,) at the start of the first, by default zero.
    """
    if OBSERVED_PATH not in model.features or not len(schedule):
        return model, schedule
    starts, stops, seen, elapsed, inputs = schedule
    path = np.add.accumulate(np.concatenate([np.zeros((1, model.m)) if start is None else start[None], values]), axis=0)
    given = PathInputs.of(inputs, model.input_hold, np.append(starts[0], stops), path)
    return with_path_as_inputs(model), Schedule(starts, stops, seen, elapsed, given)


def record_along(record: Record, schedule: Schedule) -> Record:
    """Return the record with the inputs of a schedule."""
    return record if schedule.inputs is record.inputs else replace(record, inputs=schedule.inputs)
