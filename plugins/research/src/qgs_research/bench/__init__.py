"""Benchmark of speed, memory and size of models, with any number of recipes in one run."""
