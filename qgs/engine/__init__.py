"""Training and evaluation."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qgs.engine.evaluation import Evaluation, evaluate
    from qgs.engine.folder import RunFolder
    from qgs.engine.guard import CollapseError, NonFiniteError, TrainingError
    from qgs.engine.training import TrainingResult, train

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
    "CollapseError": "qgs.engine.guard",
    "Evaluation": "qgs.engine.evaluation",
    "NonFiniteError": "qgs.engine.guard",
    "RunFolder": "qgs.engine.folder",
    "TrainingError": "qgs.engine.guard",
    "TrainingResult": "qgs.engine.training",
    "evaluate": "qgs.engine.evaluation",
    "train": "qgs.engine.training",
}


def __getattr__(name: str) -> Any:
    """Import on first use: accelerate takes a second to load."""
    if name not in _MODULES:
        raise AttributeError(f"module 'qgs.engine' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
