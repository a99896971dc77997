"""Kernels of the particle filter: random numbers, formulas, the motion of particles, moves of their noise, and islands."""
