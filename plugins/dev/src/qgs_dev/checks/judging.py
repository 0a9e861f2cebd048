"""What losses and metrics alone promise."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import (
    Loss,
    Metric,
    MetricInput,
)
from qgs.types import LayerPrediction
from qgs_dev.case import CannotCheck, Case, expect
from qgs_dev.inputs import Maker, Sizes, inputs_of
from qgs_dev.registry import check
from qgs_dev.trees import (
    cloned,
    difference,
    leaves,
    mapped,
)


@check({"losses"})
def check_loss_is_a_mean_over_scenes(case: Case) -> None:
    """The terms of a batch are the mean of those of its scenes."""
    module, inputs = case.lively(), inputs_of(case)
    alone = [module(*map_tensors(lambda x, s=s: x[s : s + 1], inputs).values()) for s in range(2)]
    found = difference(_mean(*alone), module(*inputs.values()), 1e-4, 1e-6)
    expect(not found, f"against the mean over scenes, {found}")


@check({"losses"})
def check_masked_queries_are_not_judged(case: Case) -> None:
    """What stands where the state's mask is False, with opacity 0, changes no term."""
    module, inputs = case.lively(), inputs_of(case)
    prediction, other = (inputs_of(case, seed=seed)["prediction"] for seed in range(2))
    batch, queries = prediction.state.features.shape[:2]
    mask_BN = (torch.arange(batch * queries) % 3 != 1).view(batch, queries)
    mask_BN = mask_BN.to(prediction.state.features.device)

    def seen(given: LayerPrediction) -> Any:
        opacities = given.gaussians.opacities * _over(mask_BN, given.gaussians.opacities)
        gaussians = replace(given.gaussians, opacities=opacities)
        state = replace(given.state, mask=mask_BN)
        return module(**{**inputs, "prediction": LayerPrediction(gaussians, state)})

    others = leaves(other)
    moved = mapped(prediction, lambda n, x: torch.where(_over(mask_BN, x), x, others[n]))
    found = difference(seen(prediction), seen(moved), 1e-4, 1e-6)
    expect(not found, f"when masked queries and their Gaussians change, {found}")


def _over(mask_BN: Tensor, x: Tensor) -> Tensor:
    """The mask of queries for a tensor of them or of their Gaussians, (B, N or G, 1, ...)."""
    of_each = mask_BN.repeat_interleave(x.shape[1] // mask_BN.shape[1], 1)
    return of_each.view(*of_each.shape, *[1] * (x.ndim - 2))


@check({"losses"})
def check_renderings_as_declared(case: Case) -> None:
    """A loss needs the renderings that `renderings` declares: of each view, of all, or none."""
    module, inputs = case.lively(), inputs_of(case)
    assert isinstance(module, Loss)
    terms = module(*inputs.values())
    for name, term in terms.items():
        expect(term.ndim == 0, f"the term `{name}` is of shape {tuple(term.shape)}, not 0-d")
    if module.renderings == "each":
        alone = []
        for view in range(2):
            seen = map_tensors(lambda x, v=view: x[:, v : v + 1], inputs["rendering"])
            target = inputs["target"].select([view])
            alone.append(module(inputs["prediction"], seen, target, inputs["inputs"]))
        found = difference(_mean(*alone), terms, 1e-4, 1e-6)
        expect(not found, f"`each` is declared; against the mean over views, {found}")


def _mean(one: dict[str, Tensor], other: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: (one[name] + other[name]) / 2 for name in one}


@check({"metrics"})
def check_metric_gives_its_columns(case: Case) -> None:
    """Given what it `needs` and no more, a metric has a finite value for each of its columns.

    The same each time; it changes nothing that it is given.
    """
    module = _metric(case)
    for noise in (0.0, 0.2):
        given = _metric_input(case, module, noise)
        before = cloned(given)
        values, again = (_values(module, given) for _ in range(2))
        keys = sorted(module.columns())
        expect(sorted(values) == keys, f"it has values for {sorted(values)}, columns for {keys}")
        broken = [key for key, value in values.items() if not value.isfinite().all()]
        expect(not broken, f"the values of the columns {broken} are not finite")
        expect(not difference(values, again), f"the second time {difference(values, again)}")
        found = difference(before, given)
        expect(not found, f"it changes what it is given: {found}")


@check({"metrics"})
def check_truth_scores_best(case: Case) -> None:
    """What equals the true images scores no worse than what does not, as `better` says."""
    module = _metric(case)
    true, false = (_values(module, _metric_input(case, module, noise)) for noise in (0.0, 0.2))
    for key, column in module.columns().items():
        pair = true[key].mean().item(), false[key].mean().item()
        seen = f"{column.heading} is {pair[0]:.4g} for the truth, {pair[1]:.4g} for a noisy image"
        expect(column.best(pair) == pair[0], f"{column.better} is better, but {seen}")


def _metric(case: Case) -> Metric:
    module = case.build()
    if module.unavailable:
        raise CannotCheck(module.unavailable)
    return module.eval()


def _metric_input(case: Case, module: Metric, noise: float) -> MetricInput:
    """True views, and images and depth that are off by `noise`; only what the metric needs."""
    maker = Maker(case, Sizes(batch=1), torch.Generator().manual_seed(0))
    needs, target = module.needs, maker.target()
    depth = maker.uniform(1, 2, 1, 2, 1, *maker.image)
    off = noise * maker.normal(*target.images.shape)
    return MetricInput(
        images=target.images + off,
        targets=target if "masks" in needs else replace(target, masks=None),
        gaussians=maker.gaussians() if "gaussians" in needs else None,
        gaussians_per_query=2,
        depth=depth + off[:, :, :1] if "depth" in needs else None,
        true_depth=depth if "true_depth" in needs else None,
    )


def _values(module: Metric, given: MetricInput) -> dict[str, Tensor]:
    with torch.no_grad():
        values = module(given)
    return {"": values} if isinstance(values, Tensor) else dict(values)
