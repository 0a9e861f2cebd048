"""Warnings that are told once, however often a scene is opened."""

from __future__ import annotations

import logging
from functools import lru_cache

_log = logging.getLogger(__name__)


@lru_cache(maxsize=4096)
def warn_once(message: str) -> None:
    """Log `message`, unless this process has logged it before."""
    _log.warning("%s", message)
