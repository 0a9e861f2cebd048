"""Checks of the contract suite, one module for each subject; checks.toml lists all checks."""
