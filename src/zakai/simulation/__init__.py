"""Simulated paths of the state and records of their observations."""
