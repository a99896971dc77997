"""What an online filter knows after an observation."""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from zakai import _display
from zakai.densities import Density, ProductDensity
from zakai.densities.product import renamed
from zakai.engine.blocks import SMALLEST_IS_WORST
from zakai.engine.feed import Feed, Moment
from zakai.errors import InputError
from zakai.models.prior import GaussianPrior
from zakai.notes.health import warnings_of_step
from zakai.records.dates import dated

if TYPE_CHECKING:
    from zakai.engine.online import Online


class Estimate:
    """The posterior at a time: its moments, the health of the step, and the whole density."""

    __slots__ = ("_online", "_feeds", "_moments", "_density")

    def __init__(self, online: Online, moments: tuple[Moment, ...]):
        self._online, self._feeds, self._moments = online, online.feeds, moments
        self._density: Density | None = None

    def __repr__(self) -> str:
        names = self._online.model.state
        deviations = np.sqrt(np.maximum(np.diag(self.cov), 0.0))
        parts = [f"{name} = {mean:.6g} +- {deviation:.3g}" for name, mean, deviation in zip(names, self.mean, deviations)]
        return f"Estimate(t = {self.time:.12g}: {_display.short_names(parts)})"

    def _repr_html_(self) -> str:
        deviations = np.sqrt(np.maximum(np.diag(self.cov), 0.0))
        parts = zip(self._online.model.state, self.mean, deviations, self.interval(), strict=True)
        rows = [(name, *map(_display.number, (mean, spread, *ends))) for name, mean, spread, ends in parts]
        header = ("", "mean", "deviation", "2.5 %", "97.5 %")
        return _display.html_table(f"Estimate at t = {_display.number(self.time)}", header, rows, self.warnings)

    @property
    def time(self) -> float:
        """The time of the estimate."""
        return self._moments[0].time

    @property
    def date(self) -> np.datetime64 | None:
        """The date of the estimate, of a filter with a unit and an origin."""
        clock = self._online.clock
        return None if clock is None else clock.dates(np.array([self.time]))[0]

    @property
    def mean(self) -> np.ndarray:
        """The mean of the state (n,)."""
        means = [self._part(i).mean() if one.info is None else one.info.mean for i, one in enumerate(self._moments)]
        if len(means) == 1:
            return means[0]
        mean = np.empty(self._online.model.n)
        for block, part in zip(self._online.blocks, means, strict=True):
            mean[list(block.states)] = part
        return mean

    @property
    def cov(self) -> np.ndarray:
        """The covariance of the state (n, n)."""
        covs = [self._part(i).cov() if one.info is None else one.info.cov for i, one in enumerate(self._moments)]
        if len(covs) == 1:
            return covs[0]
        cov = np.zeros((self._online.model.n,) * 2)
        for block, part in zip(self._online.blocks, covs, strict=True):
            cov[np.ix_(block.states, block.states)] = part
        return cov

    @property
    def log_likelihood_increment(self) -> float:
        """What the observation adds to the log-likelihood; zero where there was none."""
        return sum(float(one.info.log_likelihood_increment) for one in self._moments if one.info is not None)

    @property
    def health(self) -> dict[str, float]:
        """The health figures of the step, of blocks the worst."""
        worst: dict[str, float] = {}
        for moment in self._moments:
            for name, figure in ({} if moment.info is None else moment.info.health).items():
                choose = min if name in SMALLEST_IS_WORST else max
                worst[name] = choose(float(figure), worst[name]) if name in worst else float(figure)
        return worst

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for every bound that this step exceeded, and for what else is to be known of it."""
        said: dict[str, None] = {}
        for feed, moment in zip(self._feeds, self._moments, strict=True):
            said.update(dict.fromkeys(feed.notes(moment)))
            if moment.info is not None:
                method = feed.setting.method
                said.update(dict.fromkeys(warnings_of_step(moment.info.health, method.bounds, method.losses)))
        return tuple(dated(said, self._online.clock))

    @property
    def density(self) -> Density:
        """The conditional density of the state."""
        if self._density is None:
            model, blocks = self._online.model, self._online.blocks
            parts = [renamed(self._part(i), block.names) for i, block in enumerate(blocks)]
            angles = tuple(name in model.periodic for name in model.state)
            self._density = parts[0]
            if len(parts) > 1:
                self._density = ProductDensity(parts, tuple(block.states for block in blocks), model.state, angles)
        return self._density

    def interval(self, probability: float = 0.95) -> np.ndarray:
        """Return the credible interval of each coordinate (n, 2): half of the rest lies outside on each side."""
        if not 0 < probability < 1:
            raise InputError(f"interval: the probability {probability!r} must be between 0 and 1")
        tail = 0.5 * (1 - probability)
        online, found = self._online, np.empty((self._online.model.n, 2))
        for i, (feed, moment) in enumerate(zip(self._feeds, self._moments, strict=True)):
            info = moment.info
            if info is not None and _is_gaussian(feed):
                half = _deviations(1 - tail) * np.sqrt(np.maximum(info.cov.diagonal(), 0.0))
                part = np.array([info.mean - half, info.mean + half]).T
            else:
                part = self._part(i).quantile([tail, 1 - tail]).T
            found[list(online.blocks[i].states)] = part
        return found

    def _part(self, index: int) -> Density:
        return self._feeds[index].density(self._moments[index])


@lru_cache(maxsize=8)
def _deviations(probability: float) -> float:
    return NormalDist().inv_cdf(probability)


def _is_gaussian(feed: Feed) -> bool:
    """Return whether the density is a Gaussian at all times."""
    name, prior = feed.setting.method.name, feed.setting.prior
    gaussian = name in ("kalman-bucy", "conditionally-gaussian") and isinstance(prior, GaussianPrior)
    return name == "extended-kalman-bucy" or gaussian
