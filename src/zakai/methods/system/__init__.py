"""What methods of several kinds need of a model: its formulas as arrays, inputs, priors, likelihoods, potentials."""
