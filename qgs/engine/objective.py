"""What a training step computes: forward, render every supervised layer, weigh the losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from qgs.contracts import Loss, TrainingConfig
from qgs.data.sampling import Batch
from qgs.engine.distributed import average_gradients, unsynchronised, whole
from qgs.engine.guard import measure
from qgs.metrics import psnr
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views


class Leaves:
    """Detached copies of what a layer predicts, which sum up the gradients of several losses.

    A loss frees its graph as soon as it is added, so memory does not grow with their number;
    `attach` then leads the sums into the network, which needs one backward pass for all of them.
    """

    def __init__(self, layer: LayerPrediction, parameters: Mapping[str, Tensor]) -> None:
        """parameters: of the losses, by name: what they have gradients for besides the layer."""
        self._sources = {name: p for name, p in parameters.items() if p.requires_grad}
        self._leaves = dict(self._sources)
        self._gradients: dict[str, Tensor] = {}
        gaussians = {f.name: getattr(layer.gaussians, f.name) for f in fields(layer.gaussians)}
        self.layer = LayerPrediction(
            Gaussians(**{name: self._cut(name, source) for name, source in gaussians.items()}),
            QueryState(
                self._cut("features", layer.state.features),
                {name: self._cut(name, source) for name, source in layer.state.fields.items()},
            ),
        )

    def add(self, loss: Tensor) -> None:
        """Add the gradients of a 0-d loss of `layer`, if it has any, and free its graph."""
        if not loss.requires_grad:
            return
        with torch.autocast(loss.device.type, enabled=False):
            leaves = list(self._leaves.values())
            found = torch.autograd.grad(loss, leaves, allow_unused=True)
        for name, gradient in zip(self._leaves, found, strict=True):
            if gradient is not None:
                before = self._gradients.get(name)
                self._gradients[name] = gradient if before is None else before + gradient

    @property
    def gradients(self) -> Mapping[str, Tensor]:
        """The sums so far, of the Gaussians and of the state, without those that no loss reads."""
        return self._gradients

    def attach(self, value: Tensor) -> Tensor:
        """The 0-d `value`, with the summed gradients for its own."""
        sources = [self._sources[name] for name in self._gradients]
        return _KnownGradients.apply(value, tuple(self._gradients.values()), *sources)

    def _cut(self, name: str, source: Tensor) -> Tensor:
        if not source.requires_grad:
            return source
        self._sources[name] = source
        self._leaves[name] = source.detach().requires_grad_()
        return self._leaves[name]


class _KnownGradients(torch.autograd.Function):
    """value, gradients, sources -> value, whose gradients with respect to the sources are known."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, gradients: tuple[Tensor, ...], *sources: Tensor) -> Tensor:
        ctx.save_for_backward(*gradients)
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(slopes[0] * gradient for gradient in ctx.saved_tensors)


Observer: TypeAlias = Callable[[str, Any], None]
"""Told the name and the value of what is computed, in order; values are containers of tensors."""


@dataclass(frozen=True)
class Signs:
    """What renderings of several views look like, 0-d: mean PSNR, `qgs.engine.guard.measure`."""

    psnr: Tensor
    alpha: Tensor
    deviation: Tensor


@dataclass(frozen=True)
class Outcome:
    """total: 0-d. terms: weighted by layer, detached. signs: of the last supervised layer."""

    total: Tensor
    terms: Mapping[str, Tensor]
    signs: Signs


class Objective(nn.Module):
    """The model with its losses, one module so that distributed wrappers see one forward.

    The forward pass takes the losses' gradients with respect to the Gaussians too, one layer and
    `render_views` target views at a time (0: all views), and frees each part's graph before it
    makes the next; the backward pass leads their sums into the network. Memory thus grows neither
    with the supervised layers nor with the target views, and no gradient depends on `render_views`.
    Where a loss needs all renderings at once, only the renderer's graphs are made in parts.

    observe: see `Observer`; for looking at a step that went wrong.
    """

    def __init__(
        self, model: QueryGaussianModel, losses: Mapping[str, Loss], render_views: int = 0
    ) -> None:
        super().__init__()
        if not losses:
            raise ValueError("a recipe needs at least one loss to train; add one under `losses`")
        self.model = model
        self.losses = nn.ModuleDict(losses)
        self.render_views = render_views
        self.observe: Observer = lambda name, value: None
        self._blind = {name: loss for name, loss in losses.items() if loss.renderings == "none"}
        self._seeing = {name: loss for name, loss in losses.items() if loss.renderings != "none"}
        self._all_at_once = any(loss.renderings == "all" for loss in losses.values())
        self._owners: dict[str, str] = {}

    def forward(self, inputs: Views, targets: Views) -> Outcome:
        """Reconstruct `inputs` and compare with `targets`, layers weighted by the supervision.

        Raises ValueError when two losses name a term alike.
        """
        prediction = self.model(inputs)
        total, terms = targets.images.new_zeros(()), {}
        signs = []
        for number, weight in self.model.supervision.weights().items():
            layer = prediction.layers[number]
            self.observe(f"prediction of layer {number}", layer)
            leaves = Leaves(layer, dict(self.losses.named_parameters()))
            of_layer, signs = self._supervise(leaves, targets, weight, f"layer {number}")
            self.observe(f"gradient of layer {number}", leaves.gradients)
            total = total + leaves.attach(_sum(of_layer))
            _accumulate(terms, of_layer)
        return Outcome(total, terms, _over_parts(signs))

    def _supervise(
        self, leaves: Leaves, targets: Views, weight: float, name: str
    ) -> tuple[dict[str, Tensor], list[tuple[float, Signs]]]:
        """Add a layer's losses to `leaves`; its terms, detached, and signs of parts with shares."""
        terms: dict[str, Tensor] = {}
        signs: list[tuple[float, Signs]] = []

        def add(losses: Mapping[str, Loss], rendering: Rendering, part: Views) -> None:
            found = self._terms(losses, leaves.layer, rendering, part)
            self.observe(f"loss of {name}", found)
            share = weight * _count(part) / _count(targets)
            weighted = {term: share * value for term, value in found.items()}
            leaves.add(_sum(weighted))
            _accumulate(terms, weighted)

        for part in self._parts(targets):
            rendering = self._render(leaves.layer.gaussians, part.cameras)
            self.observe(f"rendering of {name}", rendering)
            signs.append((_count(part) / _count(targets), self._signs(rendering, part)))
            add(self._seeing, rendering, part)
        add(self._blind, _rendering_of_no_views(targets), targets)
        return terms, signs

    def _parts(self, targets: Views) -> list[Views]:
        """The target views as the losses take them."""
        if self._all_at_once or not self.render_views:
            return [targets]
        return [targets.select(part) for part in _slices(_count(targets), self.render_views)]

    def _render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """The rendering for all `cameras`; the graphs of at most `render_views` exist at a time."""
        views = cameras.shape[1]
        if views <= (self.render_views or views):
            return self.model.render(gaussians, cameras)
        parts = [
            checkpoint(self.model.render, gaussians, cameras[:, part], use_reentrant=False)
            for part in _slices(views, self.render_views)
        ]
        return Rendering(
            rgb=torch.cat([part.rgb for part in parts], 1),
            alpha=torch.cat([part.alpha for part in parts], 1),
            depth=torch.cat([part.depth for part in parts], 1),
        )

    def _terms(
        self,
        losses: Mapping[str, Loss],
        layer: LayerPrediction,
        rendering: Rendering,
        target: Views,
    ) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        for name, loss in losses.items():
            new = loss(layer, rendering, target)
            repeated = sorted(term for term in new if self._owners.setdefault(term, name) != name)
            if repeated:
                raise ValueError(
                    f"losses.{name} and losses.{self._owners[repeated[0]]} both have terms "
                    f"{repeated}; a recipe can use each such loss once"
                )
            terms |= new
        return terms

    @torch.no_grad()
    def _signs(self, rendering: Rendering, target: Views) -> Signs:
        background = rendering.rgb.new_tensor(self.model.renderer.config.background)
        alpha, deviation = measure(rendering.rgb, rendering.alpha, background)
        return Signs(psnr(rendering.rgb, target.images).mean(), alpha, deviation)


def _over_parts(parts: list[tuple[float, Signs]]) -> Signs:
    """The signs of all views from those of their parts, each with its share of the views."""
    return Signs(
        psnr=torch.stack([share * signs.psnr for share, signs in parts]).sum(),
        alpha=torch.stack([share * signs.alpha for share, signs in parts]).sum(),
        deviation=torch.stack([signs.deviation for _, signs in parts]).amax(),
    )


def _rendering_of_no_views(target: Views) -> Rendering:
    scenes, size = target.images.shape[0], target.cameras.size
    three, one = (target.images.new_empty((scenes, 0, channels, *size)) for channels in (3, 1))
    return Rendering(rgb=three, alpha=one, depth=one)


def _count(views: Views) -> int:
    return views.images.shape[1]


def _slices(count: int, step: int) -> list[slice]:
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]


def _sum(terms: Mapping[str, Tensor]) -> Tensor:
    return torch.stack([*terms.values()]).sum() if terms else torch.zeros(())


def _accumulate(sums: dict[str, Tensor], terms: Mapping[str, Tensor]) -> None:
    for name, term in terms.items():
        sums[name] = sums.get(name, 0) + term.detach()


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
