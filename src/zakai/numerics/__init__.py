"""Numerical kernels that know no model: flows, grids, propagators, quadrature, complex-step derivatives."""
