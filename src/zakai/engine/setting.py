"""What is filtered by what, and what is prepared for it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.errors import InputError
from zakai.methods._protocol import Method, Prepared, State
from zakai.models.domain import NEGLIGIBLE
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.prior import DensityPrior, Prior
from zakai.numerics.one_thread import one_thread
from zakai.records.schedule import Schedule

_ENDS = (
    "in two or more states the density must vanish before the ends of the domain, and have a value beyond them; take the "
    "logarithm of a positive state as the state, or guided-particles"
)
KEPT = 8  # schedules whose preparation is kept for each model


class Setting(NamedTuple):
    """A model, the prior to begin with, the method and its options.

    `theta` (p,) are the values of the parameters; `autonomous`: nothing depends on where an interval begins.
    """

    model: Model
    prior: Prior | None
    method: Method[Any, Any]
    options: Mapping[str, Any]
    theta: np.ndarray
    autonomous: bool

    @classmethod
    def of(cls, model: Model, prior: Prior | None, method: Method[Any, Any], options: Mapping[str, Any]) -> Setting:
        """Return the setting with the model's own parameters, and the variant of the method for the model and the options."""
        method = method if method.variant is None else method.variant(model, options)
        return cls(model, prior, method, options, model.theta(), not (model.depends_on_time or method.absolute))

    @property
    def parameters(self) -> set[str]:
        """The names of the parameters on which the likelihood depends."""
        model, prior = self.model, self.prior
        coefficients = [model.diffusion, model.process_noise, model.observation_noise, model.cross_noise]
        law = [*model.family_parameters.values(), *([] if model.log_density is None else [model.log_density])]
        symbols = set().union(*(part.free_symbols for part in [model.drift, model.observation, *coefficients, *law]))
        if isinstance(prior, DensityPrior):
            symbols |= prior.log_density.free_symbols
        return {symbol.name for symbol in symbols}

    @one_thread
    def prepared(self, schedule: Schedule) -> Prepared:
        """Return what the method prepares for a schedule, kept for the last schedules of each model.

        Of a model that does not depend on t every interval begins at zero, so that equal lengths are prepared equally.
        """
        schedule = schedule.from_zero() if self.autonomous else schedule
        result: Prepared = kept(
            self.model,
            "schedules",
            lambda: self.method.prepare(self.model, schedule, self.theta, **self.options),
            (self.method.name, tuple(sorted(self.options.items())), self.theta.tobytes(), *schedule.key()),
            KEPT,
        )
        return result

    @property
    def prior_has_ends(self) -> bool:
        """Whether the prior is a density of several states of which some have a domain."""
        return self.model.n > 1 and bool(self.model.domain) and isinstance(self.prior, DensityPrior)

    @property
    def _ends(self) -> str:
        """What to do where ends of a domain cut a prior, nothing where the method takes it."""
        return "" if self.method.name == "guided-particles" else f"; {_ENDS}"

    @one_thread
    def begin(self) -> tuple[Prepared, State]:
        """Return what is prepared for no interval, and the state at the model's start."""
        prepared = self.prepared(Schedule.empty(self.model.m))
        inside = self.prior_has_ends
        try:
            state = self.method.init(prepared, self.prior)
        except InputError as error:
            words = str(error)
            words = f"{self.model.source}: {words}" if words.startswith("prior") else words
            error.args = (f"{words}{self._ends}" if inside else words,)
            raise
        if inside:
            self._check_domain(self.method.density(prepared, state))
        return prepared, state

    def _check_domain(self, density: Density) -> None:
        """Raise InputError where the prior of several states has mass outside of the domain."""
        for name, interval in self.model.domain.items():
            low, high = density.marginal(name).quantile([NEGLIGIBLE, 1 - NEGLIGIBLE]).ravel()
            if low < interval.lower or high > interval.upper:
                where = f"has mass outside of the domain of {name!r}, {interval}"
                raise InputError(f"{self.model.source}: prior: {where}{self._ends}")
