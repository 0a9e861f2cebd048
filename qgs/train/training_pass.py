"""Forward and backward pass of a training step: objective, model, losses and gradients."""

from collections.abc import Sequence
from contextlib import nullcontext

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from qgs.containers import concatenated, map_tensors, named_tensors
from qgs.contracts import Outcome, TrainingConfig
from qgs.data.samples import Batch
from qgs.geometry.constants import constant
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.precision import autocast
from qgs.recipe import Recipe
from qgs.types import Cameras, Gaussians, LayerPrediction, Prediction, Rendering, Views

Tensors = dict[str, Tensor]
"""Tensors by name: terms, signs of life, gradients or parameters."""
RECORDED = {"step", "seconds", "lr", "loss", "psnr", "alpha", "deviation", "gradient", "skipped"}
"""Names of values in history.jsonl. A loss term must not have one of these names."""


class TrainingPass(nn.Module):
    """Model, losses and objective as one module, which implements `Passes` for the objective.

    `forward` passes a batch to `objective.forward`, which calls `predict` (the model) and `judge`
    (renderings and losses). One module holds all of them, so that DDP sees one forward pass even if
    the objective runs the model several times.

    To save memory, `judge` computes the gradients of the losses with respect to the Gaussians
    immediately, for one layer and `render_views` target views at a time (0: all views), and frees
    each autograd graph before the next. The backward pass through the model starts from the sums of
    these gradients. If a loss needs all renderings at once, only the renderer splits the views.
    """

    def __init__(self, recipe: Recipe, model: QueryGaussianModel) -> None:
        """Build the objective and the losses of `recipe`; `model` must be the recipe's model."""
        super().__init__()
        self.model = model
        self.objective = recipe.build_objective()
        losses = recipe.build_losses()
        if not losses:
            raise ValueError("training needs at least one loss; add one under `losses`")
        self.losses = nn.ModuleDict(losses)
        self.reads_depths = any(loss.reads_depths for loss in losses.values())
        self._owners: dict[str, str] = {}  # names of terms to those of their losses
        self.render_views = recipe.training.render_views
        self.judge_inputs = recipe.training.judge_inputs

    def forward(self, inputs: Views, targets: Views) -> Outcome:
        """Return the objective's `Outcome` for a batch of input and target views.

        Raises ValueError if a term of the loss has a reserved name.
        """
        # Input views are appended to the targets.
        targets = targets.joined(inputs) if self.judge_inputs else targets
        outcome = self.objective.forward(inputs, targets, self)
        if taken := sorted(outcome.terms.keys() & RECORDED):
            kinds = f"losses or the objective {self.objective.name}"
            raise ValueError(f"terms of {kinds} use reserved names: rename {taken}")
        return outcome

    def predict(self, inputs: Views) -> Prediction:
        """Return the model's prediction; implements `Passes.predict`."""
        return self.model(inputs)

    def judge(self, prediction: Prediction, targets: Views, inputs: Views) -> Outcome:
        """Sum the losses of all supervised layers; implements `Passes.judge`.

        The supervision sets the weight of each layer. `Outcome.signs` has the numbers of
        `signs_of` (PSNR, alpha, deviation) for the last layer.
        Raises ValueError if two losses have a term of the same name.
        """
        parameters: Tensors = dict(self.losses.named_parameters(prefix="losses"))
        total = targets.images.new_zeros(())
        background = constant(self.model.renderer.config.background, targets.images)
        count = targets.images.shape[1]
        parts = [targets]
        # Not split if a loss compares views.
        if self.render_views and not any(x.renderings == "all" for x in self.losses.values()):
            parts = [targets.select(views) for views in _slices(targets.cameras, self.render_views)]
        terms: Tensors = {}
        signs: Tensors = {}
        rounds = [number for number in prediction.layers if number > len(self.model.decoder)]
        for number, weight in self.model.supervision.weights(rounds).items():
            layer = DetachedLayer(prediction.layers[number], parameters)
            # Reset for every layer, so that those of the last layer remain.
            signs = {}
            deviations: list[Tensor] = []
            for part in parts:
                share = part.images.shape[1] / count
                rendering = self.render(layer.prediction.gaussians, part.cameras)
                shown = signs_of(rendering, part, background)
                deviations.append(shown.pop("deviation"))
                _add({name: share * mean for name, mean in shown.items()}, signs)
                found = self._terms(True, layer.prediction, rendering, part, inputs)
                layer.add(found, weight * share)
            signs["deviation"] = torch.stack(deviations).amax()
            # Losses of the Gaussians alone run once for all parts, with a rendering without views.
            no_views = map_tensors(lambda x: x[:, :0].detach(), rendering)
            found = self._terms(False, layer.prediction, no_views, targets, inputs)
            layer.add(found, weight)
            # The layers are summed here: one backward pass through the network serves all.
            total = total + layer.total()
            _add(layer.terms, terms)
        return Outcome(total, terms, signs)

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render Gaussians; implements `Passes.render`.

        Views are rendered in groups of at most `render_views`. The backward pass renders each group
        again, so that only one group needs memory at a time.
        """
        if not self.render_views or cameras.shape[1] <= self.render_views:
            return self.model.render(gaussians, cameras)
        # Rendered again in the backward pass: memory for one part instead of all.
        parts = [
            checkpoint(self.model.render, gaussians, cameras[:, views], use_reentrant=False)
            for views in _slices(cameras, self.render_views)
        ]
        return concatenated(parts, 1)

    def _terms(
        self,
        of_images: bool,
        prediction: LayerPrediction,
        rendering: Rendering,
        target: Views,
        inputs: Views,
    ) -> Tensors:
        """Call the losses of images, or those of Gaussians alone; return all terms by name."""
        terms: Tensors = {}
        for name, loss in self.losses.items():
            if of_images == (loss.renderings == "none"):
                continue
            found = loss(prediction, rendering, target, inputs)
            for term, value in found.items():
                owner = self._owners.setdefault(term, name)
                if owner != name:
                    raise ValueError(
                        f"losses.{name} and losses.{owner} both have a term {term}: remove one of "
                        "them from the recipe"
                    )
                terms[term] = value
        return terms


def compute_gradients(
    accelerator: Accelerator,
    training_pass: nn.Module,
    config: TrainingConfig,
    batches: Sequence[Batch],
) -> Tensors:
    """Compute the clipped gradients of the mean loss of `batches`; return 0-d values by name.

    training_pass: the module wrapped by accelerate. The value "gradient" is the norm over all
    processes before clipping. All other values, such as "loss", are of this process. The host does
    not wait for the device.
    """
    device = accelerator.device
    sums: Tensors = {}
    for number, batch in enumerate(batches, start=1):
        # Only the last batch exchanges gradients between processes.
        last = number == len(batches)
        with nullcontext() if last else accelerator.no_sync(training_pass):
            with autocast(config.precision, device.type):
                outcome: Outcome = training_pass(batch.inputs.to(device), batch.targets.to(device))
            accelerator.backward(outcome.total / len(batches))
        found = {"loss": outcome.total.detach(), **outcome.terms, **outcome.signs}
        for name, value in found.items():
            sums[name] = sums.get(name, 0) + value / len(batches)
    # After the exchange, so that all processes clip by the same norm.
    norm = accelerator.clip_grad_norm_(training_pass.parameters(), config.clip)
    sums["gradient"] = torch.as_tensor(norm, device=device)
    return sums


class DetachedLayer:
    """Detached copy of a layer's prediction, which collects the gradients of losses.

    gradients: sums of gradients by name of the tensor in the prediction; tensors that no loss reads
    are absent. terms: detached sums of the losses' terms.
    """

    def __init__(self, layer: LayerPrediction, parameters: Tensors) -> None:
        """Detach `layer`. parameters: parameters of the losses by name, which get gradients too."""
        self.prediction: LayerPrediction = map_tensors(
            lambda x: x.detach().requires_grad_() if x.requires_grad else x, layer
        )
        self.gradients: Tensors = {}
        self.terms: Tensors = {}
        self._sources = _trained(parameters, layer)
        self._copies = _trained(parameters, self.prediction)

    def add(self, terms: Tensors, share: float) -> None:
        """Add `share` times the 0-d `terms` and their gradients, and free their autograd graph."""
        weighted = {name: share * term for name, term in terms.items()}
        _add(weighted, self.terms)
        loss = _sum(weighted)
        if not loss.requires_grad:
            return
        # A backward pass runs in the dtypes of the forward one; autocast would cast it again.
        with torch.autocast(loss.device.type, enabled=False):
            found = torch.autograd.grad(loss, list(self._copies.values()), allow_unused=True)
        gradients = zip(self._copies, found, strict=True)
        _add(
            {name: gradient for name, gradient in gradients if gradient is not None}, self.gradients
        )

    def total(self) -> Tensor:
        """Return the 0-d sum of the terms; its backward pass gives `gradients` to the model."""
        total = _sum(self.terms)
        for name, gradient in self.gradients.items():
            # The graph of the losses is freed. Their gradient g with respect to a source x reaches
            # the rest of the model through <x, g>, whose gradient is g. Its own value is
            # subtracted, so that the total does not change.
            linear = (self._sources[name] * gradient).sum()
            total = total + (linear - linear.detach())
        return total


@torch.no_grad()
def signs_of(rendering: Rendering, target: Views, background: Tensor) -> Tensors:
    """Return the 0-d numbers "psnr", "alpha" and "deviation" of a rendering.

    psnr, alpha: means over all views. deviation: mean of |rgb - background| over the pixels of a
        view, for the view where this mean is largest. In a mean over pixels, a single stray
        Gaussian does not hide that the rendering is otherwise empty.
    """
    deviation = (rendering.rgb - background[:, None, None]).abs().mean((-3, -2, -1))
    return {
        "psnr": psnr(rendering.rgb, target.images).mean(),
        "alpha": rendering.alpha.mean(),
        "deviation": deviation.amax(),
    }


def _slices(cameras: Cameras, step: int) -> list[slice]:
    return [slice(first, first + step) for first in range(0, cameras.shape[1], step)]


def _trained(parameters: Tensors, layer: LayerPrediction) -> Tensors:
    tensors = parameters | dict(named_tensors(layer))
    return {name: tensor for name, tensor in tensors.items() if tensor.requires_grad}


def _sum(terms: Tensors) -> Tensor:
    return torch.stack([*terms.values()]).sum() if terms else torch.zeros(())


def _add(terms: Tensors, sums: Tensors) -> None:
    for name, term in terms.items():
        term = term.detach()
        sums[name] = sums[name] + term if name in sums else term
