"""Training and evaluation."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qgs.engine.collapse import CollapseError, NonFiniteError, TrainingError
    from qgs.engine.evaluation import Evaluation, evaluate
    from qgs.engine.folder import RunFolder
    from qgs.engine.trainer import TrainingResult, train

__all__ = [
    "CollapseError",
    "Evaluation",
    "NonFiniteError",
    "RunFolder",
    "TrainingError",
    "TrainingResult",
    "evaluate",
    "train",
]

_MODULES = {
    "CollapseError": "qgs.engine.collapse",
    "Evaluation": "qgs.engine.evaluation",
    "NonFiniteError": "qgs.engine.collapse",
    "RunFolder": "qgs.engine.folder",
    "TrainingError": "qgs.engine.collapse",
    "TrainingResult": "qgs.engine.trainer",
    "evaluate": "qgs.engine.evaluation",
    "train": "qgs.engine.trainer",
}


def __getattr__(name: str) -> Any:
    """Import on first use: accelerate takes a second to load."""
    if name not in _MODULES:
        raise AttributeError(f"module 'qgs.engine' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
