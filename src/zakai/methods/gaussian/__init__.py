"""Gaussians and families of them: what `kalman-bucy`, `benes`, `hu-yau` and `general-direct` share."""
