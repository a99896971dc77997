"""The power series of the Kolmogorov equation, for `kolmogorov-series`."""
