"""Words shared by the errors of this package: where something is wrong, and what the user may have meant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches

from zakai.errors import InputError


@contextmanager
def named(place: str) -> Iterator[None]:
    """Put the place (a file, a key) in front of any InputError raised inside; its type is kept."""
    try:
        yield
    except InputError as error:
        # A part of a key, such as [0], follows the key at once: drift[0], not drift: [0].
        error.args = (f"{place}{error}" if str(error).startswith("[") else f"{place}: {error}",)
        raise


def echo(value: object, length: int = 20) -> str:
    """The value as one short printable word, whatever it holds."""
    try:
        text = value if isinstance(value, str) else str(value)[:200]
    except ValueError:  # Python refuses to print integers of more than 4,300 digits
        text = hex(value)  # type: ignore[arg-type]
    return ascii(text if len(text) <= length else text[:length] + "...")


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """`; did you mean 'drift'?`, or nothing when no option is close."""
    known, parts = list(options), word[:64].split("_")
    close = get_close_matches(word[:64], known, n=1, cutoff=0.6)
    if min(map(len, parts)) >= 3:  # obs_noise is short for observation_noise
        alike = [one for one in known if one.count("_") == len(parts) - 1]
        close = [one for one in alike if all(map(str.startswith, one.split("_"), parts))] or close
    return f"; did you mean {close[0]!r}?" if close else ""


def listing(options: Iterable[str]) -> str:
    """The options as a list in words, those beyond the first 12 as their number, or 'none'."""
    words = list(options)
    rest = [f"and {len(words) - 12} more"] if len(words) > 12 else []
    return ", ".join([*words[:12], *rest]) or "none"
