"""Gradients of one optimiser step, and the numbers that tell how the model does."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext

import torch
from accelerate import Accelerator
from torch import Tensor, nn

from qgs.contracts import TrainingConfig
from qgs.data.sampling import Batch
from qgs.engine.objective import Outcome
from qgs.engine.processes import average_gradients, unsynchronised, whole


class Gradients:
    """Runs batches forward and backward through an objective that `Accelerator.prepare` wrapped."""

    def __init__(
        self, accelerator: Accelerator, objective: nn.Module, config: TrainingConfig
    ) -> None:
        self.accelerator = accelerator
        self.objective = objective
        self.config = config

    def compute(self, batches: Sequence[Batch]) -> dict[str, Tensor]:
        """Gradients of the mean over `batches`, clipped; what was measured, as 0-d tensors.

        Only the last batch exchanges gradients between processes. "gradient" is the norm before
        clipping, over all processes; the rest is of this one.
        """
        sums: dict[str, Tensor] = {}
        for batch in batches:
            last = batch is batches[-1]
            with nullcontext() if last else unsynchronised(self.accelerator, self.objective):
                for name, value in self._backward(batch, len(batches)).items():
                    sums[name] = sums.get(name, 0) + value / len(batches)
        average_gradients(self.accelerator, self.objective)
        norm = self.accelerator.clip_grad_norm_(self.objective.parameters(), self.config.clip)
        sums["gradient"] = whole(torch.as_tensor(norm)).to(self.accelerator.device)
        return sums

    def _backward(self, batch: Batch, count: int) -> dict[str, Tensor]:
        device = self.accelerator.device
        inputs, targets = batch.inputs.to(device), batch.targets.to(device)
        bf16 = self.config.precision == "bf16"
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
            outcome: Outcome = self.objective(inputs, targets)
        self.accelerator.backward(outcome.total / count)
        signs = outcome.signs
        return {
            "loss": outcome.total.detach(),
            **outcome.terms,
            "psnr": signs.psnr,
            "alpha": signs.alpha,
            "deviation": signs.deviation,
        }
