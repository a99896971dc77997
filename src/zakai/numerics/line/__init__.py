"""Densities of one state on a uniform grid: operators, transitions, loops, derivatives and adjoints."""
