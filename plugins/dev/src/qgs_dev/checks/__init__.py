"""The checks, by subject, as checks.toml lists them."""
