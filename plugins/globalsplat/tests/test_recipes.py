"""Recipes: published sizes by arithmetic, what is refused, and that a small one learns."""

from pathlib import Path
from typing import Any

import pytest
import torch

import qgs
from qgs.composer import RecipeError, resolve

RECIPES = Path(__file__).parents[3] / "recipes"

D, MEMORY, HEADS = 512, 512 + 256, 8
NORM = 2 * D
HEAD_NORM = 2 * (D // HEADS)
PATCHES = 8 * 8 * (3 * 512 + 6 * 256)
CAMERA = (4 * 64 + 64) + (64 * 64 + 64) + ((64 + 27) * 256 + 256)
ENCODER = PATCHES + CAMERA + 4 * MEMORY
TOKENS = 2048 + 4 + 1 + 4
QUERIES = TOKENS * D + 2 * (NORM + D * D + D)
MLP = (D * 4 * D + 4 * D) + (4 * D * D + D)
SELF_ATTENTION = (D * 3 * D + 3 * D) + (D * D + D) + 2 * HEAD_NORM
BLOCK = 2 * NORM + SELF_ATTENTION + MLP + 2 * D
CROSS = 2 * MEMORY + (MEMORY * 2 * D + 2 * D) + NORM + 2 * (D * D + D) + 2 * HEAD_NORM
STREAM = CROSS + D + NORM + MLP + D + 2 * BLOCK
MIXER = 2 * NORM + (2 * D * D + D) + (D * 2 * D + 2 * D) + 2 * D
ROUND = 2 * STREAM + MIXER
GEOMETRY, TEXTURE = 16 * (3 + 10 + 1), 16 * 16 * 3
HEAD = 2 * NORM + (D * GEOMETRY + GEOMETRY) + (D * TEXTURE + TEXTURE)

PUBLISHED = 84_329_312


def test_parameters_of_the_published_size() -> None:
    assert ENCODER + QUERIES + 4 * ROUND + HEAD == PUBLISHED
    model = qgs.compose(RECIPES / "globalsplat" / "re10k.yaml", device="meta")
    assert {name: sum(p.numel() for p in part.parameters()) for name, part in (
        ("encoder", model.encoder), ("queries", model.queries), ("head", model.head)
    )} == {"encoder": ENCODER, "queries": QUERIES, "head": HEAD}  # fmt: skip
    assert sum(p.numel() for p in model.parameters()) == PUBLISHED
    assert (len(model.queries.slots), len(model.queries.extra)) == (2048, 9)


def test_published_training() -> None:
    recipe = resolve(RECIPES / "globalsplat" / "re10k.yaml")
    ((_, schedules),) = recipe.schedules.items()
    level = schedules["level"]
    numbers = {step: level.number(step) for step in (0, 9_999, 12_000, 22_000, 52_000, 219_999)}
    assert list(numbers.values()) == [0, 0, 1, 2, 3, 3]
    assert [level.number(s) for s in (10_000, 10_500, 15_000, 21_500, 51_000)] == [
        0,
        0.25,
        1,
        1.75,
        2.5,
    ]
    optimizer = recipe.tree["optimizer"]
    assert optimizer["initial_divisor"] * optimizer["final_divisor"] == 50
    assert optimizer["warmup"] == 0.03 * recipe.training.steps


def refused(*overrides: str) -> str:
    with pytest.raises(RecipeError) as caught:
        resolve(RECIPES / "tiny" / "globalsplat.yaml", list(overrides))
    return str(caught.value)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("model.decoder.layer.memory_width=null", "96 float32"),
        ("model.encoder.rgb_width=32", "64 float32"),
        ("model.queries={type: qgs/latent, count: 8}", "globalsplat.texture"),
        ("model.decoder.layer={type: qgs/cross_self_mlp}", "memory.keys"),
        ("model.decoder.cross_attention={type: qgs/content}", "cross_attention"),
        ("model.head.level=5", "model.head.level"),
        ("model.head.level={schedule: linear, values: [0, 4.5], at: [1, 9]}", "model.head.level"),
        ("model.queries.extra=256", "model.queries.extra"),
        ("data.image_size=[60, 64]", "patch_size"),
    ],
)
def test_what_cannot_work_is_refused(override: str, named: str) -> None:
    assert named in refused(override)


@pytest.mark.parametrize(
    "overrides",
    [
        ["model.centers={type: qgs/free}"],
        ["model.encoder={type: qgs/multiview_vit}", "model.decoder.layer.memory_width=null"],
        ["model.head={type: qgs/gaussian_head, gaussians_per_query: 8}"],
        ["plugins=[locus, rooms]", "losses.visibility={type: qgs/visibility}"],
    ],
)
def test_parts_of_other_models_stand_beside_it(overrides: list[str]) -> None:
    model = qgs.compose(RECIPES / "tiny" / "globalsplat.yaml", overrides=overrides)
    assert model(photos(2)).gaussians.count == 2048


def photos(count: int) -> qgs.Views:
    draw = torch.Generator().manual_seed(0)
    cameras = qgs.Cameras(
        torch.eye(4).repeat(1, count, 1, 1),
        torch.tensor([20.0, 20, 8, 8]).expand(1, count, 4),
        (16, 16),
    )
    waves = torch.nn.functional.interpolate(
        torch.rand(count, 3, 3, 3, generator=draw), size=(16, 16), mode="bilinear"
    )
    return qgs.Views(waves[None], cameras)


SMALL = (
    *("model.width=32", "model.heads=2", "model.decoder.depth=1", "model.supervision.layers=[1]"),
    *("model.queries.count=40", "model.encoder.patch_size=4", "data.image_size=[16, 16]"),
)


def test_it_learns_a_picture_in_a_blink() -> None:
    """With every loss; PSNR rises by more than 4 dB in 60 steps."""
    torch.manual_seed(0)
    regularised = [*SMALL, "losses.regularisers={type: globalsplat/regularisers}"]
    recipe = resolve(RECIPES / "tiny" / "globalsplat.yaml", regularised)
    model, losses = recipe.build_model().train(), recipe.build_losses()
    shown = photos(1)
    views = shown.joined(shown)
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    errors: list[float] = []
    for _ in range(60):
        (layer,) = model(views).layers.values()
        rendering = model.render(layer.gaussians, shown.cameras)
        terms: dict[str, Any] = {}
        for loss in losses.values():
            terms |= loss(layer, rendering, shown, views)
        optimizer.zero_grad()
        sum(terms.values()).backward()
        optimizer.step()
        errors.append((rendering.rgb - shown.images).square().mean().item())
    assert terms.keys() >= {"mse", "frustum", "mean_opacity", "mean_scale"}
    assert errors[-1] < 0.4 * errors[0]


def test_gaussians_of_extra_tokens_are_never_seen() -> None:
    model = qgs.compose(RECIPES / "tiny" / "globalsplat.yaml", overrides=list(SMALL))
    opacities = model.eval()(photos(2)).gaussians.opacities.unflatten(1, (40, -1))
    assert (opacities[:, :31] > 0).all()
    assert not opacities[:, 31:].any()
