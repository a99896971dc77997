"""What a belief is: Gaussian mixtures and densities on a lattice, behind one protocol."""

from zakai.densities._density import Density
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity

__all__ = ["Density", "GaussianMixture", "GridDensity"]
