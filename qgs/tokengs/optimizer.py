"""AdamW with a one-cycle learning rate, or with any schedule of a recipe."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch.optim import AdamW

from qgs.contracts import Optimizer, OptimizerConfig, ParameterGroup

WARMUP_TIME = 0.1
"""Largest fraction of a time budget that is used for warm-up."""

Decay = Annotated[float, Field(ge=0, lt=1)]


class OneCycleAdamW(Optimizer):
    """AdamW with a learning rate that rises and falls along cosines (LocusGS release).

    The rise ends after `warmup` optimiser steps or after the fraction WARMUP_TIME of a time budget,
    whichever is earlier. `warmup_shape` can make the rise linear. The fall follows the used
    fraction of the steps or of the seconds, whichever is larger. Without a time budget this is
    torch's `OneCycleLR` with pct_start = warmup / steps.

    A schedule for `learning_rate` replaces rise and fall. Then warmup and divisors have no effect.
    """

    name = "adamw"

    class Config(OptimizerConfig):
        """Options of the learning rate's cycle and of AdamW."""

        learning_rate: NonNegativeFloat = 4e-4
        """Peak learning rate, at the end of the warm-up. A schedule given here replaces the whole
        cycle of warm-up and fall."""
        warmup: NonNegativeInt = 2000
        """Optimiser steps until the learning rate reaches its peak. 0 starts at the peak."""
        warmup_shape: Literal["cosine", "linear"] = "cosine"
        """Shape of the learning rate's rise to its peak."""
        initial_divisor: float = Field(default=25.0, ge=1)
        """Peak learning rate divided by the first learning rate."""
        final_divisor: PositiveFloat = 1000.0
        """First learning rate divided by the last one, as in torch's OneCycleLR. A value below 1
        makes the last one larger."""
        betas: tuple[Decay, Decay] = (0.9, 0.95)
        """AdamW's decay rates for the averages of gradients and of their squares."""
        weight_decay: NonNegativeFloat = 0.05
        """AdamW's weight decay. It applies to parameters for which `ModelComponent.decays` is true.
        0 means no decay."""

    config: Config
    _descent_starts: float | None = None

    def check(self) -> None:
        """Raise ValueError if the warm-up fills all steps and no time budget shortens it."""
        warmup = self.config.warmup
        steps = self.training.steps
        if not self.follows_schedule and self.training.seconds is None and warmup >= steps:
            raise ValueError(
                f"optimizer.warmup is {warmup}, but training.steps is {steps}: the learning rate "
                "would never fall; lower warmup or train for longer"
            )

    def build(self, groups: Sequence[ParameterGroup]) -> AdamW:
        """Build torch's fused AdamW; groups with `decays` false get a weight decay of 0."""
        decay = self.config.weight_decay
        own = [{**group, "weight_decay": decay if group["decays"] else 0.0} for group in groups]
        return AdamW(own, lr=self.config.learning_rate, betas=self.config.betas, fused=True)

    def learning_rate(self, step: int, seconds: float) -> float:
        """Return the learning rate: that of the recipe's schedule, or else that of the cycle."""
        if self.follows_schedule:
            return super().learning_rate(step, seconds)
        config = self.config
        peak = config.learning_rate
        first = peak / config.initial_divisor
        # steps - 1: the last step has the last rate, as in torch's OneCycleLR.
        of_steps = step / max(self.training.steps - 1, 1)
        of_seconds = seconds / (self.training.seconds or math.inf)
        used = min(max(of_steps, of_seconds), 1.0)
        if self._descent_starts is None:
            top = config.warmup - 1
            warmed = max(step / top if top > 0 else 1.0, of_seconds / WARMUP_TIME)
            if warmed < 1:
                if config.warmup_shape == "linear":
                    return first + (peak - first) * warmed
                return _cosine(first, peak, warmed)
            # Kept, since a later end of the budget must not bring the warm-up back.
            self._descent_starts = used
        left = 1 - self._descent_starts
        part = (used - self._descent_starts) / left if left > 0 else 1.0
        return _cosine(peak, first / config.final_divisor, min(part, 1.0))

    def state(self) -> Mapping[str, float | None]:
        """Return `descent_starts`: budget fraction at which the rate began to fall; None before."""
        return {"descent_starts": self._descent_starts}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self._descent_starts = state["descent_starts"]


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2 * (1 + math.cos(math.pi * part))
