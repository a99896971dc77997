"""The parts of the particle filter `guided-particles`."""
