"""A component that is sound, two packages deep."""

from __future__ import annotations

from typing import ClassVar

from qgs.components import MlpFeedForward


class DeepInside(MlpFeedForward):
    name: ClassVar[str] = "deep_inside"
