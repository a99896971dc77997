"""What is estimated from records: parameters by maximum likelihood, limits and profiles, and posterior samples."""
