"""What a training step computes: forward, render every supervised layer, weigh the losses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from qgs.contracts import Loss
from qgs.model import QueryGaussianModel
from qgs.types import LayerPrediction, Rendering, Views


@dataclass(frozen=True)
class Outcome:
    """total: 0-d. terms: weighted by layer, detached. rendering: the last layer's."""

    total: Tensor
    terms: Mapping[str, Tensor]
    rendering: Rendering


class Objective(nn.Module):
    """The model with its losses, one module so that distributed wrappers see one forward."""

    def __init__(self, model: QueryGaussianModel, losses: Mapping[str, Loss]) -> None:
        super().__init__()
        if not losses:
            raise ValueError("a recipe needs at least one loss to train; add one under `losses`")
        self.model = model
        self.losses = nn.ModuleDict(losses)

    def forward(self, inputs: Views, targets: Views) -> Outcome:
        """Reconstruct `inputs` and compare with `targets`, layers weighted by the supervision.

        Raises ValueError when two losses name a term alike.
        """
        prediction = self.model(inputs)
        totals: dict[str, Tensor] = {}
        rendering = None
        for number, weight in self.model.supervision.weights().items():
            layer = prediction.layers[number]
            rendering = self.model.render(layer.gaussians, targets.cameras)
            for name, term in self._terms(layer, rendering, targets).items():
                totals[name] = totals.get(name, 0) + weight * term
        assert rendering is not None
        total = torch.stack(list(totals.values())).sum()
        return Outcome(total, {name: term.detach() for name, term in totals.items()}, rendering)

    def _terms(
        self, layer: LayerPrediction, rendering: Rendering, targets: Views
    ) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        for name, loss in self.losses.items():
            new = loss(layer, rendering, targets)
            repeated = sorted(terms.keys() & new.keys())
            if repeated:
                raise ValueError(
                    f"losses.{name} and an earlier loss both have terms {repeated}; "
                    "a recipe can use each such loss once"
                )
            terms |= new
        return terms
