"""Filters of other libraries, run by `zakai.filter`."""
