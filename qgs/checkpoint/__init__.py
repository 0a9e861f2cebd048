"""Checkpoints: weights with the recipe of their model, by path, name or URL."""
