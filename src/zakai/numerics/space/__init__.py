"""Densities of two to four states on a grid that moves with them."""
