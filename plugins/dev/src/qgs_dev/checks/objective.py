"""What objectives promise, seen by lending them passes of a model that is none."""

from typing import Any

import torch
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import Outcome
from qgs.renderers import TorchRenderer
from qgs.types import Cameras, Gaussians, LayerPrediction, Prediction, Rendering, Views
from qgs_dev.case import Case, expect
from qgs_dev.inputs import Maker, Sizes
from qgs_dev.modules import seeded
from qgs_dev.registry import check
from qgs_dev.trees import cloned, difference, not_finite

SIGNS = {"psnr", "alpha", "deviation"}


class Rehearsal:
    """`Passes` whose model is one parameter, `gain`: Gaussians as bright as the inputs are."""

    def __init__(self, maker: Maker) -> None:
        self.gain = nn.Parameter(torch.ones(()))
        self._layer = maker.prediction()
        self._renderer = TorchRenderer(TorchRenderer.Config())
        self.predicted, self.judged = 0, 0

    def predict(self, inputs: Views) -> Prediction:
        """See `Passes`."""
        expect(inputs.images.shape[1] > 0, "it predicts from no view")
        self.predicted += 1
        bright = self.gain * inputs.images.mean((1, 2, 3, 4))[:, None]
        given = self._layer.gaussians
        gaussians = Gaussians(
            given.means, given.scales, given.quats, given.opacities * bright, given.colors
        )
        layer = LayerPrediction(gaussians, self._layer.state)
        return Prediction(gaussians, layer.state, {1: layer})

    def judge(self, prediction: Prediction, targets: Views, inputs: Views) -> Outcome:
        """See `Passes`."""
        self.judged += 1
        rendering = self.render(prediction.gaussians, targets.cameras)
        error = (rendering.rgb - targets.images).square().mean()
        signs = {"psnr": -error, "alpha": rendering.alpha.mean(), "deviation": error}
        return Outcome(error, {"error": error.detach()}, map_tensors(Tensor.detach, signs))

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """See `Passes`."""
        return self._renderer(gaussians, cameras)


@check({"objective"})
def check_objective_gives_an_outcome(case: Case) -> None:
    """An objective predicts and judges; its total is the sum of its terms, and trains the model.

    It has no parameters. Terms and signs are 0-d and detached; the signs are those that training
    watches.
    """
    module = case.build()
    expect(not isinstance(module, nn.Module), "it is an nn.Module; objectives have no parameters")
    for views in (2, 3, 5):
        outcome, passes = _outcome(case, module, views)
        where = f"with {views} input views"
        kind = type(outcome).__name__
        expect(isinstance(outcome, Outcome), f"{where} it gives {kind}, not an Outcome")
        expect(bool(passes.predicted and passes.judged), f"{where} it judges no prediction")
        numbers = {"total": outcome.total, **outcome.terms, **outcome.signs}
        odd = sorted(n for n, x in numbers.items() if not isinstance(x, Tensor) or x.ndim)
        expect(not odd, f"{where} {', '.join(odd)} is no 0-d tensor")
        expect(not not_finite(numbers), f"{where} {', '.join(not_finite(numbers))} is not finite")
        kept = sorted(n for n, x in numbers.items() if n != "total" and x.requires_grad)
        expect(not kept, f"{where} {', '.join(kept)} is not detached")
        signs = set(outcome.signs)
        expect(signs == SIGNS, f"{where} its signs are {sorted(signs)}, not {sorted(SIGNS)}")
        found = difference(sum(outcome.terms.values()), outcome.total.detach(), 1e-4, 1e-6)
        expect(not found, f"{where}, against the sum of the terms, {found}")
        reached = outcome.total.requires_grad and torch.autograd.grad(outcome.total, passes.gain)[0]
        expect(bool(reached), f"{where} its total has no gradient in the model's parameters")


@check({"objective"})
def check_objective_repeats(case: Case) -> None:
    """Under one seed an objective gives the same each time: it counts and keeps nothing."""
    module = case.build()
    found = difference(rehearsed(case, module), rehearsed(case, module))
    expect(not found, f"the second time, {found}")


def rehearsed(case: Case, module: Any) -> dict[str, Tensor]:
    """What an objective gives in a rehearsal."""
    return cloned(_numbers(_outcome(case, module, 3)[0]))


def _outcome(case: Case, module: Any, views: int) -> tuple[Outcome, Rehearsal]:
    maker = Maker(case, Sizes(views=views), torch.Generator().manual_seed(0))
    passes = Rehearsal(maker)
    with seeded(0):
        return module.forward(maker.inputs(), maker.target(), passes), passes


def _numbers(outcome: Outcome) -> dict[str, Tensor]:
    return {"total": outcome.total, **outcome.terms, **outcome.signs}
