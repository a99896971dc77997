"""One state between ends that reflect it, or with kinks in its formulas: polynomials on elements."""
