"""Noticing a run that died or met numbers that are not finite, and what is saved then."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from qgs.engine.distributed import whole
from qgs.io.checkpoint import unique_tensors

EMPTY_ALPHA = 2e-3
"""Mean alpha below which a rendering shows the background alone."""

FLAT = 1 / 255
"""Mean deviation from the background of a rendering that shows nothing else."""

NO_GRADIENT = 1e-8
"""Gradient norm of a model that learns nothing any more."""

COLLAPSE_REMEDIES = (
    "a learning rate too high for this model (lower training.learning_rate, lengthen "
    "training.warmup)",
    "a visibility loss too strong or absent (try losses.visibility.weight 0.1 with "
    "behind_camera: invisible)",
    "an initialisation that hides every Gaussian (raise model.head.opacity_bias, check "
    "views.scale_factor against the anchors' and the scenes' depth)",
)

BROKEN_REMEDIES = (
    "a learning rate too high for this model (lower training.learning_rate, lengthen "
    "training.warmup)",
    "a range that bfloat16 does not hold (training.precision: float32)",
    "data that is not finite: images, poses or intrinsics (look at the scenes of `data`; with "
    "views.scale distance, at input cameras that almost stand on one point)",
)


class TrainingError(RuntimeError):
    """Training stopped by itself; the message tells why, what is kept and what to do."""


class CollapseError(TrainingError):
    """The model died; the last good weights are kept."""


class NonFiniteError(TrainingError):
    """A step gave NaN or infinity; the run is saved as it was before that step."""


@dataclass(frozen=True)
class Vitals:
    """Signs of life of one step: numbers, so that reading them synchronises once."""

    alpha: float
    deviation: float
    gradient: float


def measure(rgb: Tensor, alpha: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
    """Mean alpha, and the largest of the views' mean |rgb - background|; both 0-d.

    rgb: (B, V, 3, H, W). Means over a view's pixels, so that a stray splat is no sign of life.
    """
    deviation = (rgb - background[:, None, None]).abs().mean((-3, -2, -1))
    return alpha.mean(), deviation.amax()


class CollapseDetector:
    """Counts consecutive steps without signs of life.

    A step is dead when nothing is drawn (mean alpha under EMPTY_ALPHA, which is also what a model
    shows whose Gaussians are all invisible), when no gradient is left, or when the images have gone
    back to the plain background after showing more.
    """

    def __init__(self, window: int) -> None:
        self.window = window
        self.dead_steps = 0
        self.symptom = ""
        self._has_drawn = False

    def observe(self, vitals: Vitals) -> None:
        """Take note of one step."""
        self.symptom = self._symptom_of(vitals)
        self.dead_steps = self.dead_steps + 1 if self.symptom else 0
        self._has_drawn |= vitals.deviation > 8 * FLAT

    @property
    def collapsed(self) -> bool:
        """Whether the window is full of dead steps."""
        return self.dead_steps >= self.window

    def dead_after(self, steps: int) -> bool:
        """Whether a run that ends after `steps` never lived, or filled the window with death."""
        return self.dead_steps >= min(self.window, steps)

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.checkpoint.Stateful`."""
        return {"dead": self.dead_steps, "symptom": self.symptom, "has_drawn": self._has_drawn}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`."""
        self.dead_steps, self.symptom = state["dead"], state["symptom"]
        self._has_drawn = state["has_drawn"]

    def _symptom_of(self, vitals: Vitals) -> str:
        if vitals.alpha < EMPTY_ALPHA:
            return f"the renderings are empty (mean alpha {vitals.alpha:.1e})"
        if vitals.gradient < NO_GRADIENT:
            return f"the gradient has vanished (norm {vitals.gradient:.1e})"
        if self._has_drawn and vitals.deviation < FLAT:
            return "the renderings equal the background"
        return ""


class GoodWeights:
    """Host copies of the weights from healthy times, the older of the last two.

    A collapse is noticed late, and the newest healthy copy may already be on its way down; the
    older one is at least a window away.

    keep: whether this process holds the copies; one of several suffices.
    """

    def __init__(self, model: nn.Module, keep: bool = True) -> None:
        self._model = model
        self._keep = keep
        self._copies = [(0, self._copy())]

    def refresh(self, step: int) -> None:
        """Copy the present weights, which `step` optimiser steps made. All processes must call."""
        self._copies = [*self._copies, (step, self._copy())][-2:]

    @property
    def step(self) -> int:
        """Optimiser steps behind `tensors`."""
        return self._copies[0][0]

    @property
    def tensors(self) -> Mapping[str, Tensor]:
        """Weights as `qgs.io.checkpoint.save` takes them."""
        return self._copies[0][1]

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.checkpoint.Stateful`."""
        copies = enumerate(tensors for _, tensors in self._copies)
        return {
            "steps": [step for step, _ in self._copies],
            **{f"{i}/{name}": t for i, tensors in copies for name, t in tensors.items()},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.checkpoint.Stateful`."""
        self._copies = [
            (step, {name: state[f"{i}/{name}"] for name in self._copies[0][1]})
            for i, step in enumerate(state["steps"])
        ]

    def _copy(self) -> dict[str, Tensor]:
        copies: dict[str, Tensor] = {}
        for name, tensor in unique_tensors(self._model).items():
            gathered = whole(tensor)
            if self._keep:
                copies[name] = gathered.to("cpu", copy=True)
        return copies


def broken_tensors(model: nn.Module) -> str:
    """Which tensors of `model` hold NaN or infinity; "" if none does."""
    names = [n for n, t in unique_tensors(model).items() if not whole(torch.isfinite(t).all())]
    return f"weights are not finite: {_listed(names)}" if names else ""


def not_finite(terms: Mapping[str, float], module: nn.Module, gradient: float) -> str:
    """What is NaN or infinite: loss terms, else tensors with such gradients; "" if nothing is."""
    bad = [
        f"loss term {name} is {value}" for name, value in terms.items() if not math.isfinite(value)
    ]
    if bad:
        return ", ".join(bad)
    if math.isfinite(gradient):
        return ""
    names = [
        name
        for name, parameter in module.named_parameters()
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all()
    ]
    return f"the gradient norm is {gradient}" + (f", from {_listed(names)}" if names else "")


def _listed(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
