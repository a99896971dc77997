"""The parts of `extended-kalman-bucy`."""
