"""Reconstruction of scenes from photos, files of results, and recording of a model's internals."""
