"""Time-varying Yau systems: their coefficients, their gauge, and power series of their kernels."""
