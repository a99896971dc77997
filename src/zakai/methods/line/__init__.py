"""One state on a grid: what `yau-yau`, `limited-direct` and `kolmogorov-series` share."""
