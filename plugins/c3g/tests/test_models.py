"""Whole models: recipes, sizes as published, parts of LocusGS beside C3G's, and that it learns."""

from pathlib import Path
from typing import Any

import pytest
import torch
from qgs_plugintools import Case
from qgs_plugintools.checks.fields import run_training_step
from qgs_plugintools.inputs import Maker, Sizes
from refusals import refused
from training_runs import first_batch

import qgs
from qgs.composer import Recipe, resolve
from qgs.composer.registry import load_registry
from qgs.contracts.schedule import follow
from qgs.types import named_tensors

RECIPES = Path(__file__).parents[3] / "recipes"

D, N = 2048, 2048
LAYER = 2 * (2 * D) + 3 * D * D + (D * D + D) + (D * 2 * D + 2 * D) + (2 * D * D + D)
HEAD = 2 * D + (D * 14 + 14)
DECODER = N * D + 2 * LAYER + HEAD
"""What C3G trains beside its backbone."""

NORMS = 2 * (D // 16)
BLOCK = 2 * (2 * D) + (3 * D * D + 3 * D) + 2 * NORMS + (D * D + D) + 8 * D * D + 5 * D + 2 * D
EMBEDDINGS = 9 * 14 * 14 * D + 2 * (D + 2 * D)
ENCODER = EMBEDDINGS + 6 * BLOCK + 2 * D + (2 * D * D + 2 * D) + NORMS


def sizes(recipe: str) -> dict[str, int]:
    model = qgs.compose(RECIPES / recipe, device="meta")
    parts = {"all": model, "encoder": model.encoder}
    return {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}


def test_parameters_of_the_published_size() -> None:
    assert DECODER == 71_368_718
    assert sizes("c3g/re10k.yaml") == {"all": ENCODER + DECODER, "encoder": ENCODER}


def test_the_published_recipe_has_a_gaussian_for_each_query() -> None:
    model = qgs.compose(RECIPES / "c3g/re10k.yaml", device="meta")
    assert (model.queries.count, model.head.gaussians_per_query) == (2048, 1)
    assert resolve(RECIPES / "c3g/re10k.yaml").training.judge_inputs


@pytest.mark.parametrize("step", [0, 999, 1000, 1001, 2500, 3000, 3999, 4000, 449_999])
def test_the_dilation_is_divided_by_3_every_1000_steps(step: int) -> None:
    renderer = qgs.compose(RECIPES / "c3g/re10k.yaml", device="meta").renderer
    follow([renderer], step)
    expected = max(0.3, 10 / 3 ** (step // 1000))
    assert renderer.config.dilation == pytest.approx(expected, rel=1e-6)


OWN_LAYER = {"depth": 2, "layer": {"type": "c3g/joint"}}


def recipe(decoder: Any = OWN_LAYER, **model: Any) -> dict[str, Any]:
    small = {
        "width": 16,
        "heads": 2,
        "encoder": {"depth": 1},
        "queries": {"count": 6},
        "decoder": decoder,
        "head": {"type": "c3g/head"},
        "centers": {"type": "qgs/offset"},
        "supervision": {"layers": [2]},
        "renderer": {"type": "qgs/torch"},
    }
    return {
        "recipe": 1,
        "plugins": ["c3g", "locus", "ellipsoid", "tokengs2026"],
        "model": {**small, **model},
    }


def ran(written: dict[str, Any]) -> Recipe:
    composed = resolve(written)
    run_training_step(composed, CASE)
    return composed


REGISTRY = load_registry(["c3g"])
CASE = Case(REGISTRY.components("layer")["c3g/joint"].Config())

ANCHORED = {"type": "locus/anchored", "count": 6}


def test_anchors_move_and_place_gaussians_beside_joint_attention() -> None:
    composed = ran(
        recipe(
            {**OWN_LAYER, "refinement": {"type": "locus/refine"}},
            queries=ANCHORED,
            centers={"type": "locus/radius_scaled"},
            supervision={"layers": [1, 2]},
        )
        | {"losses": {"anchors": {"type": "locus/anchor_visibility"}}}
    )
    model = composed.build_model().train()
    views = Maker(CASE, Sizes(), torch.Generator().manual_seed(0)).views()
    first, last = model(views).layers.values()
    assert not torch.equal(first.state["anchor.center"], last.state["anchor.center"])
    off = last.gaussians.means - last.state["anchor.center"]
    assert off.norm(dim=-1).max() < 5


@pytest.mark.parametrize(
    ("slot", "part"),
    [
        ("cross_attention", {"type": "locus/ray_biased"}),
        ("cross_attention", {"type": "ellipsoid/ray_biased"}),
        ("self_attention", {"type": "locus/anchor_aware"}),
        ("feed_forward", {"type": "qgs/mlp"}),
    ],
)
def test_what_stands_in_another_layer_is_refused(slot: str, part: dict[str, str]) -> None:
    problem = refused(recipe({**OWN_LAYER, slot: part}, queries=ANCHORED))
    assert problem.reason.startswith("`c3g/joint` ")
    assert f"has no slot `{slot}`" in problem.reason
    assert problem.fix.startswith("remove it")


def test_tokens_of_another_width_are_refused_and_of_the_models_run() -> None:
    wide = {"type": "tokengs2026/multiscale_vit", "depth": 2, "blocks": [1, 2]}
    problem = refused(recipe(encoder=wide))
    assert problem.reason.startswith("`c3g/joint` reads memory.features as D float32")
    assert "writes it as 2*D float32" in problem.reason
    ran(recipe(encoder={**wide, "blocks": [2]}))
    latents = {"type": "tokengs2026/latent_bottleneck", "depth": 1, "blocks": [1], "latents": 5}
    ran(recipe(encoder={**latents, "latent_depth": 1}))


def test_layers_of_both_kinds_may_alternate() -> None:
    second = {
        "layer": {"type": "qgs/cross_self_mlp"},
        "cross_attention": {"type": "locus/ray_biased"},
    }
    model = ran(recipe({**OWN_LAYER, "layers": {"1": second}}, queries=ANCHORED)).build_model()
    assert [type(layer).__name__ for layer in model.decoder] == ["JointLayer", "CrossSelfMlp"]


@pytest.mark.parametrize("name", ["tiny/c3g", "c3g/re10k"])
def test_every_parameter_that_trains_is_read(name: str) -> None:
    """Processes that train together wait for a gradient of each of them."""
    small = ("width=16", "heads=2", "queries.count=6", "decoder.depth=2", "supervision.layers=[2]")
    composed = resolve(RECIPES / f"{name}.yaml", [f"model.{option}" for option in small])
    model = composed.build_model().train()
    factors = composed.rate_factors(model)
    case = Case(CASE.config, image_size=(28, 28) if "re10k" in name else (16, 16))
    views = Maker(case, Sizes(), torch.Generator().manual_seed(0)).views()
    gaussians = model(views).gaussians
    torch.stack([x.sum() for _, x in named_tensors(gaussians)]).sum().backward()
    unread = {name for name, p in model.named_parameters() if p.grad is None}
    assert unread == {name for name, factor in factors.items() if factor == 0}
    assert len(unread) == 4


def test_it_learns() -> None:
    changes = ("model.queries.count=32", "model.decoder.depth=2", "model.supervision.layers=[2]")
    composed = resolve(RECIPES / "tiny/c3g.yaml", [*changes, "data.image_size=[32, 32]"])
    torch.manual_seed(0)
    model, (loss,) = composed.build_model().train(), composed.build_losses().values()
    batch = first_batch(composed)
    seen = batch.targets.joined(batch.inputs)
    optimizer = torch.optim.AdamW(model.parameters(), 2e-3)
    losses = []
    for _ in range(40):
        (prediction,) = model(batch.inputs).layers.values()
        terms = loss(
            prediction, model.render(prediction.gaussians, seen.cameras), seen, batch.inputs
        )
        optimizer.zero_grad()
        total = torch.stack(list(terms.values())).sum()
        total.backward()
        optimizer.step()
        losses.append(total.item())
    assert losses[-1] < 0.6 * losses[0]
