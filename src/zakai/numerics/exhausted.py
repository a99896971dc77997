"""The end of a computation that needs more work than it may."""


class ExhaustedError(Exception):
    """An interval needs more work than is allowed."""
