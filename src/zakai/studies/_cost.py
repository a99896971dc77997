"""What a call costs: seconds, and the memory that it took beside what was there."""

from __future__ import annotations

import sys
import time
from pathlib import Path

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Cost:
    """Measures a block: `seconds` of the clock, `bytes` by which the resident memory rose at its peak (nan where unknown).

        with Cost() as cost:
            ...

    On Linux the peak is set back first; elsewhere a block that stays below an earlier peak is seen as none.
    """

    seconds = float("nan")
    bytes = float("nan")

    def __enter__(self) -> Cost:
        self._before = _resident()
        self._begin = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self._begin
        self.bytes = max(0.0, _peak() - self._before)


def _resident() -> float:
    """The resident memory now, after which a higher one is a new peak."""
    try:
        _RESET.write_text("5")
        return _status("VmRSS:")
    except OSError:
        return _peak()


def _peak() -> float:
    try:
        return _status("VmHWM:")
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


def _status(key: str) -> float:
    for line in _STATUS.read_text().splitlines():
        if line.startswith(key):
            return 1024.0 * int(line.split()[1])
    return float("nan")
