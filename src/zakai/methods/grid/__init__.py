"""The methods for densities on a grid in one to four states: which filter of `line`, `reflecting` or `space` takes a system."""
