"""What of a model is compiled: its formulas.  The values of its parameters, its start and its prior enter as numbers."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field

from zakai.models.model import Model


@dataclass(frozen=True)
class Formulas:
    """A model, equal to every other with the same formulas, so that what is compiled for one serves them all."""

    key: Hashable
    model: Model = field(compare=False, repr=False)


def formulas(model: Model) -> Formulas:
    """The formulas of a model, to compile once for all values of its parameters."""
    matrices = (model.drift, model.diffusion, model.process_noise, model.observation, model.observation_noise)
    names = (model.state, model.parameter_symbols, model.periodic, model.functions, model.observation_kind)
    return Formulas((names, matrices), model)
