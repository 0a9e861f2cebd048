"""A module that reads a file when it is imported."""

from __future__ import annotations

import os
from typing import ClassVar

from qgs.components import MlpFeedForward

with open(os.devnull) as settings:
    SETTINGS = settings.read()


class ReadsAtImport(MlpFeedForward):
    name: ClassVar[str] = "reads_at_import"
