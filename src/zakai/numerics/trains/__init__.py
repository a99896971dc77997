"""Functions of several variables as tensor trains of quintic B-splines on a grid; kernels that know no model."""
