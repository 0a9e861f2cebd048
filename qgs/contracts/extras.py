"""Optional packages: what is told when one is needed and missing."""

from __future__ import annotations


class MissingExtraError(RuntimeError):
    """An optional package is needed; the message names it and the command that installs it."""
