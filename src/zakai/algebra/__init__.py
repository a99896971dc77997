"""Exact decisions about a model: which theorem holds, and the certificate of it."""
