"""Evaluation of a model: the views to score, the evaluation protocol, scores and their tables."""
