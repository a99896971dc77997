"""What references that take y to be linear between observations do not say: that the increments have another exact law."""

from __future__ import annotations

from collections.abc import Sequence


def within_convention(warnings: Sequence[str]) -> list[str]:
    """Return the warnings but for those of intervals too long for y linear in them, and of all intervals together."""
    return [warning for warning in warnings if not warning.startswith("y is taken as linear between observations")]
