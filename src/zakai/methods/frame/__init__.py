"""A filter of several states whose density moves in an affine frame."""
