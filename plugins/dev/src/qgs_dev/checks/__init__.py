"""The checks of the contract suite by subject; checks.toml lists them."""
