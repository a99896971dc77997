"""Mixtures of Gaussians: updates, fits and reduction."""
