"""The errors that `zakai` raises on purpose, and the exit code that the command gives each."""

from __future__ import annotations


class ZakaiError(Exception):
    """An error that is no bug in zakai; its text is one line that says what is wrong and what to do."""

    exit_code = 2


class InputError(ZakaiError):
    """A model, a record, an option or a name that cannot be used as it stands."""

    exit_code = 2


class ConditionError(ZakaiError):
    """The method that was asked for, or every method, does not hold for this system."""

    exit_code = 3
