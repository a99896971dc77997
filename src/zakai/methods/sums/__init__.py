"""The parts of `gaussian-sum`."""
