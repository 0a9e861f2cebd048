"""Fuzz tests with random invalid files and options. Each case runs in a separate process."""
