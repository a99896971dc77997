"""What to cite: the papers of the methods that gave a result, and this package, as BibTeX."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import Any

from zakai._registry import METHODS, PEERS
from zakai.errors import InputError

# The entries of citations.bib by method; each paper is in the `source` of the method too.
PAPERS = {
    "kalman-bucy": ("kalman-bucy-1961", "makowski-1986"),
    "conditionally-gaussian": ("liptser-shiryaev-1977", "makowski-1986"),
    "benes": ("benes-1981", "makowski-1986"),
    "hu-yau": ("hu-yau-2002", "makowski-1986"),
    "limited-direct": ("chen-luo-yau-2017",),
    "general-direct": ("chen-dong-survey",),
    "gaussian-sum": ("chen-dong-survey",),
    "wei-norman": ("wei-norman-1964", "yau-1993", "dong-chen-yau-2021"),
    "yau-yau": ("yau-yau-2008",),
    "kolmogorov-series": ("yau-1993",),
    "tensor-train": ("oseledets-tyrtyshnikov-2010",),
    "guided-particles": ("gordon-salmond-smith-1993", "gilks-berzuini-2001", "lee-whiteley-2018"),
    "extended-kalman-bucy": ("jazwinski-1970", "chen-luo-yau-2017"),
    "ekf": ("sarkka-2013",),
    "ukf": ("sarkka-2013", "julier-uhlmann-1997"),
    "enkf": ("evensen-1994",),
    "particle": ("gordon-salmond-smith-1993",),
}


class BibTeX(str):
    """BibTeX entries; shown as they are."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def cite(*used: Any) -> BibTeX:
    """Return the BibTeX entries of what was used: the papers of the methods, and this package.

    Args:
        *used: results of `filter`, `smooth`, `fit`, `online` or `prepare`, or names of methods.

    Raises:
        InputError: an object that no method has made, or an unknown method.

    Example:
        >>> import zakai
        >>> print(zakai.cite("benes").splitlines()[0])
        @software{zakai,
    """
    wanted = dict.fromkeys(["zakai"])
    for one in used:
        method = one if isinstance(one, str) else getattr(one, "method", None)
        names = [name for name in re.findall(r"[a-z][a-z-]*", method) if name in PAPERS] if isinstance(method, str) else []
        if not names:
            said = f"the method {one!r}" if isinstance(one, str) else f"a {type(one).__name__}"
            listed = ", ".join([*METHODS, *PEERS])
            raise InputError(f"cite: {said} is unknown; give a result, or the name of a method: {listed}")
        for name in names:
            wanted |= dict.fromkeys(PAPERS[name])
        if hasattr(one, "standard_errors"):
            wanted["byrd-lu-nocedal-zhu-1995"] = None
    return BibTeX("\n".join(_entries()[key] for key in wanted))


@cache
def _entries() -> dict[str, str]:
    """Return the entries by their keys."""
    import zakai

    text = files("zakai").joinpath("citations.bib").read_text(encoding="utf-8").replace("VERSION", zakai.__version__)
    parts = re.split(r"\n(?=@)", text)
    return {part[part.index("{") + 1 : part.index(",")]: part for part in parts}
