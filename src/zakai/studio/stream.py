"""Tasks that filter observations as they arrive, from a file that grows or from standard input."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from zakai.densities import Density
from zakai.errors import InputError
from zakai.records.stream import lines_of
from zakai.studio.data import Given
from zakai.studio.running import method_of
from zakai.studio.session import Answer, Held, Report, Session

KEPT = 2_000  # estimates that can be drawn


class Stream:
    """An online filter and its last estimates, in the shape of a result."""

    has_densities = True
    record = None
    blocks = ()
    clock = None

    def __init__(self, online: Any):
        self.online, self.model = online, online.model
        self.state = tuple(online.model.state)
        self.method, self.header, self.lines, self.count = "", b"", 0, 0
        self.estimates: deque[Any] = deque(maxlen=KEPT)
        self.log_likelihood, self.faults = 0.0, list[str]()

    @property
    def times(self) -> np.ndarray:
        """The times of the estimates that are kept."""
        return np.array([one.time for one in self.estimates])

    @property
    def mean(self) -> np.ndarray:
        """Their means."""
        return np.array([one.mean for one in self.estimates])

    @property
    def variance(self) -> np.ndarray:
        """Their variances."""
        return np.array([np.diagonal(one.cov) for one in self.estimates])

    def density(self, k: int) -> Density:
        """Return the density of estimate number k."""
        return self.estimates[k].density

    def take(self, text: str) -> int:
        """Use lines, and return how many were observations; the faults of others are kept in words."""
        body, used = text.encode("utf-8", "surrogatepass"), 0
        if not self.header and body.lstrip()[:1] not in (b"{", b""):
            head, _, body = body.lstrip().partition(b"\n")
            self.header, self.lines = head + b"\n", 1
        file = io.BytesIO(self.header + body)
        first = 1 if self.header else 0
        model = self.model
        for line in lines_of(file, model.m, model.inputs, self.online.clock, model.observation_names):
            if line.fault is not None:
                self.faults.append(f"line {self.lines + line.number - first}: {line.fault}")
                continue
            try:
                estimate = self.online.update(line.time, line.values, line.inputs)
            except InputError as error:
                self.faults.append(f"line {self.lines + line.number - first}: {error}")
                continue
            self.estimates.append(estimate)
            self.log_likelihood += float(estimate.log_likelihood_increment)
            used += 1
        self.count += used
        self.lines += body.count(b"\n")
        self.faults = self.faults[-20:]
        return used


def begin(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Begin to filter a stream with a model."""
    from zakai.engine.online import online

    model = session.model(request)
    method, options = method_of(request)
    session.online = Stream(online(model, method, **options))
    return {"states": list(model.state)}, {}


def take(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Filter lines that have arrived, and return the last estimate."""
    stream = session.online
    if stream is None:
        raise InputError("stream: the stream has ended; press Follow again")
    used = stream.take(str(request.get("lines", "")))
    if stream.estimates:
        session.keep("stream", Held(stream, None, Given(None, None, "stream")))  # type: ignore[arg-type]
    last = stream.estimates[-1] if stream.estimates else None
    return {
        "used": used,
        "count": stream.count,
        "faults": stream.faults[-3:],
        "time": None if last is None else last.time,
        "mean": None if last is None else last.mean,
        "interval": None if last is None else last.interval(0.95),
        "warnings": [] if last is None else list(last.warnings),
        "log_likelihood": stream.log_likelihood,
        "states": list(stream.state),
        "method": stream.online.method,
        "first": None if last is None else float(stream.estimates[0].time),
    }, {}


TASKS: dict[str, Callable[..., Answer]] = {"stream-begin": begin, "stream-lines": take}
