"""Sentences that every result carries: what a model, a record or the health of its steps gives reason to doubt."""
