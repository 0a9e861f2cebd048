"""Evaluation of a model: which views are scored, the protocol, the scores and their tables."""
