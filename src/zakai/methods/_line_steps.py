"""The coefficients in time of intervals that the compiled loop of one-state filters reads."""

from __future__ import annotations

import numpy as np

from zakai.methods._line_system import Coefficients, Prepared
from zakai.numerics.line_filters import kernel_size
from zakai.numerics.line_panels import GAUSS_NODES, interpolation
from zakai.numerics.line_segment import FACTOR, KERNEL, SPLIT, SPLIT_FACTOR, Steps

RESOLVED = 1e-8  # relative error of the interpolants of coefficients in time
PROBES = np.linspace(0.0, 1.0, 129)  # parts of an interval at which coefficients are compared with their interpolants



def coefficients_of(prepared: Prepared) -> Coefficients:
    """Return what the loop needs of the coefficients in time of all intervals."""
    schedule, system, theta = prepared.schedule, prepared.system, prepared.theta
    count, seen, m = len(schedule), schedule.seen, system.m
    starts, lengths, stops = schedule.starts[:, None], prepared.lengths[:, None], schedule.stops[:, None]
    nodes = starts + lengths * GAUSS_NODES if prepared.timed else np.full((count, 1), prepared.model.start)
    nodes = np.clip(nodes, starts, np.nextafter(stops, starts)) if prepared.timed else nodes
    ends = stops if system.samples else nodes
    if not system.samples and prepared.timed and system.steady_observation and system.steady_noise:
        ends = nodes[:, :1]

    def covariance(t: np.ndarray) -> np.ndarray:
        G = system.covariance(np.zeros((1, 1, 1)), t, theta)[..., 0, 0] if prepared.divides else np.zeros(1)
        return np.array(np.broadcast_to(G, t.shape))

    def factors(t: np.ndarray) -> np.ndarray:
        if prepared.mixed:  # the terms of the table are those at the nodes and at the end
            rows = [len(GAUSS_NODES)] if system.samples and t.shape[1] == 1 else range(t.shape[1])
            return np.broadcast_to(np.eye(len(GAUSS_NODES) + 1)[rows], (count, t.shape[1], len(GAUSS_NODES) + 1)).copy()
        assert system.separated is not None
        found: np.ndarray = system.separated[0](_X, t, theta)
        return np.array(np.broadcast_to(found, (*t.shape, found.shape[-1])))

    def precision(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if system.general:  # the loop takes only intervals without observations
            return np.zeros((*t.shape, m, m)), np.zeros(count)
        noise = np.broadcast_to(system.noise(_X, t, theta), (*t.shape, m, m))
        both = (seen[:, :, None] & seen[:, None])[:, None]
        block = np.where(both, noise, 0.0) + np.eye(m) * ~seen[:, None, :, None]
        constant = np.zeros(count)
        if system.samples:
            constant = -0.5 * (np.linalg.slogdet(block[:, 0])[1] + np.log(2 * np.pi) * seen.sum(axis=1))
        return np.where(both, np.linalg.inv(block), 0.0), constant

    drifts, outputs, covariances, (precisions, constants) = factors(nodes), factors(ends), covariance(nodes), precision(ends)
    good = np.ones(count, bool)
    if prepared.timed and count:
        t = probed(starts, lengths)
        good &= resolved(covariance(t)[..., None], covariances[..., None])
        if not prepared.mixed:
            good &= resolved(factors(t), factors(nodes))
        if not system.samples and not system.steady_noise:
            good &= resolved(precision(t)[0], precisions)
    return Coefficients(drifts, outputs, covariances, precisions, constants, good)


_X = np.zeros((1, 1, 1))


def probed(starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return times (K, P) at which coefficients are compared with their interpolants, of which the last are before the ends."""
    return np.clip(starts + lengths * PROBES, starts, np.nextafter(starts + lengths, starts))


def resolved(exact: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return whether the interpolants of values at the nodes (K, Q, ...) agree with those at the probes (K, P, ...)."""
    exact, nodes = exact.reshape(*exact.shape[:2], -1), nodes.reshape(*nodes.shape[:2], -1)
    scale = np.maximum(np.abs(exact).max(axis=1), 1e-300)
    rest = np.abs(_TO_PROBES @ nodes - exact).max(axis=1) / scale
    return np.asarray(rest.max(axis=1) <= RESOLVED)


_TO_PROBES = interpolation(PROBES)


def kinds_of(prepared: Prepared) -> np.ndarray:
    """Return how the compiled loop of `_line_loop` takes each interval (K,), -1 where it does not."""
    system, schedule, yau, kernels = prepared.system, prepared.schedule, prepared.yau, prepared.kernels
    positive = prepared.lengths > 0
    none = np.full(len(schedule), -1)
    if not len(schedule) or np.iscomplexobj(prepared.theta) or prepared.lie or (prepared.model.periodic and not system.samples):
        return none
    silent = ~schedule.seen.any(axis=1)
    regular = positive & np.all(schedule.seen == prepared.inside, axis=1)
    if not prepared.gaussian:
        usable = system.samples and not system.moving and system.separated is not None
        return np.where(positive & (silent | (not system.general)), FACTOR, -1) if usable else none
    if system.separated is None and not prepared.mixed:
        return none
    whole = np.zeros(len(schedule), bool)
    if kernels is not None and yau is not None and yau.unobserved and yau.steady_gauge:
        whole = positive & (kernels.place >= 0) & (kernels.errors[kernels.place] == 0)
    split = positive & prepared.divides & prepared.coefficients.resolved
    if system.samples:
        whole = whole & (silent | (not system.general))
        return np.where(whole, FACTOR, np.where(split, SPLIT_FACTOR, -1))
    inside = np.where(whole, KERNEL, -1) if yau is not None and yau.affine else np.where(split, SPLIT, -1)
    return np.where(silent, np.where(whole, FACTOR, inside), np.where(regular, inside, -1))


def steps_of(prepared: Prepared) -> Steps:
    """Return what the compiled loop reads of all intervals."""
    kinds, kernels, c = prepared.kinds, prepared.kernels, prepared.coefficients
    inputs = 1 + prepared.system.m
    packed = np.full((len(kinds), kernel_size(inputs)), np.nan)
    here = np.flatnonzero((kinds == KERNEL) | (kinds == FACTOR))
    if prepared.gaussian and kernels is not None and len(here):
        found = [part[kernels.place[here]].reshape(len(here), -1) for part in kernels.channels]
        packed[here] = np.concatenate(found, axis=1)
    precisions = np.where((kinds == KERNEL)[:, None, None, None], 0.0, c.precisions)
    lengths = np.ascontiguousarray(prepared.lengths)
    return Steps(kinds, lengths, precisions, c.constants, packed, c.drifts, c.outputs, c.covariances)
