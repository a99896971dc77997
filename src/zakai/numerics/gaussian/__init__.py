"""Steps of Gaussians, forward and backward."""
