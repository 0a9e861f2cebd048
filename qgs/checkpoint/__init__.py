"""Checkpoints: files with weights and the recipe of their model, found by path, name or URL."""
