"""Kernels of the methods by series: power series, dyadic and sinc grids."""
