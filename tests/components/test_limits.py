"""Every limit and epsilon of the releases is an option: published by default, and it matters."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import pytest
import torch
from qgs_locus import plugin
from torch import Tensor

from qgs import Cameras, Views, compose
from qgs.components import COMPONENTS
from qgs.composer import resolve
from qgs.contracts import Component
from qgs.losses import COMPONENTS as LOSSES
from qgs.types import LayerPrediction, Rendering

RECIPES = Path(__file__).parents[2] / "recipes"
CROSS, OWN = "model.decoder.cross_attention", "model.decoder.self_attention"
FEED, REFINE = "model.decoder.feed_forward", "model.decoder.refinement"
RADIUS_MIN = [f"{part}.radius_min" for part in ("model.queries", CROSS, REFINE, "model.centers")]

LOCUS: dict[str, Any] = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {
        "width": 16,
        "heads": 2,
        "encoder": {"depth": 1, "layer_scale": 0.5},
        "queries": {"type": "locus/anchored", "count": 8, "std": 1.0},
        "decoder": {
            "depth": 2,
            "layer_scale": 0.5,
            "cross_attention": {"type": "locus/ray_biased"},
            "self_attention": {"type": "locus/anchor_aware"},
            "refinement": {"type": "locus/refine"},
        },
        "head": {"gaussians_per_query": 2, "init_std": 0.5},
        "centers": {"type": "locus/radius_scaled"},
        "supervision": {"layers": [2]},
    },
}
CONTENT = [f"{CROSS}={{type: qgs/content}}", f"{OWN}={{type: qgs/content}}"]
FREE, OFFSET = "model.centers={type: qgs/free}", "model.centers={type: locus/anchor_offset}"
FIXED = f"{CROSS}.bandwidth=fixed"
NORM = "model.head.norm=true"
LIMITS: list[tuple[str, tuple[str, ...], float, float, tuple[str, ...]]] = [
    ("multiview_vit", ("model.encoder.norm_eps",), 1e-5, 0.1, ()),
    ("anchored", tuple(RADIUS_MIN), 1e-3, 3.0, ()),
    ("ray_biased", (f"{CROSS}.sigma0",), 0.1, 0.5, ()),
    ("ray_biased", (f"{CROSS}.sigma0",), 0.1, 0.5, (FIXED,)),
    ("ray_biased", (f"{CROSS}.sigma_sq_min",), 1e-3, 0.5, ()),
    ("ray_biased", (f"{CROSS}.bias_min",), -20.0, -0.1, ()),
    ("ray_biased", (f"{CROSS}.direction_eps",), 1e-6, 2.0, ()),
    ("ray_biased", (f"{CROSS}.norm_eps",), 1e-5, 0.1, ()),
    ("anchor_aware", (f"{OWN}.temperature",), 10_000.0, 100.0, ()),
    ("anchor_aware", (f"{OWN}.divisor_eps",), 1e-6, 0.1, ()),
    ("anchor_aware", (f"{OWN}.norm_eps",), 1e-5, 0.1, ()),
    ("content", (f"{CROSS}.norm_eps",), 1e-5, 0.1, tuple(CONTENT)),
    ("content", (f"{OWN}.norm_eps",), 1e-5, 0.1, tuple(CONTENT)),
    ("mlp", (f"{FEED}.norm_eps",), 1e-5, 0.1, ()),
    ("refine", (f"{REFINE}.input_limit",), 100.0, 0.01, ()),
    ("refine", (f"{REFINE}.output_limit",), 1000.0, 0.01, ()),
    ("gaussian_head", ("model.head.scale_cap",), 0.075, 0.1, ()),
    ("gaussian_head", ("model.head.scale_input_limit",), 10.0, 0.1, ()),
    ("gaussian_head", ("model.head.opacity_bias",), -2.0, 1.0, ()),
    ("gaussian_head", ("model.head.quat_eps",), 1e-4, 10.0, ()),
    ("gaussian_head", ("model.head.norm_eps",), 1e-5, 0.1, (NORM,)),
    ("radius_scaled", ("model.centers.input_limit",), 100.0, 0.1, ()),
    ("radius_scaled", ("model.centers.output_limit",), 1000.0, 0.1, ()),
    ("anchor_offset", ("model.centers.input_limit",), 100.0, 0.1, (OFFSET,)),
    ("anchor_offset", ("model.centers.output_limit",), 1000.0, 0.1, (OFFSET,)),
    ("free", ("model.centers.input_limit",), 100.0, 0.1, (FREE,)),
    ("free", ("model.centers.output_limit",), 1000.0, 0.1, (FREE,)),
    ("free", ("model.centers.z_offset",), 1.0, 0.5, (FREE,)),
    ("offset", ("model.centers.z_offset",), 1.0, 0.5, ("model.centers={type: qgs/offset}",)),
]
"""Component, its option, published default, another value, what else it takes to matter."""

LOSS_LIMITS: list[tuple[str, str, float, float, dict[str, Any]]] = [
    ("qgs/visibility", "clamp", 1.0, 0.1, {}),
    ("qgs/visibility", "near", 0.025, 0.9, {"behind_camera": "invisible"}),
    ("qgs/visibility", "infinite_pixel", 1e6, 1e3, {"clamp": None}),
    ("locus/anchor_visibility", "clamp", 1.0, 0.1, {}),
    ("locus/anchor_visibility", "near", 0.025, 0.9, {"behind_camera": "invisible"}),
    ("locus/anchor_visibility", "z_guard", 1e-3, 0.9, {"clamp": None}),
    ("qgs/opacity", "eps", 1e-6, 0.1, {}),
    ("qgs/depth_surface", "beta", 0.05, 1.0, {}),
    ("qgs/depth_surface", "near", 0.025, 2.0, {}),
]
"""Loss, its option, published default, another value, options beside which it matters."""

BEGINNINGS = {
    "std", "init_std", "position_std", "layer_scale", "init_radius", "gamma_init", "weight",
    "mse_weight", "l1_weight", "ssim_weight", "ratio", "mlp_ratio", "z_init",
}  # fmt: skip
"""Numbers that say how training starts, what it weighs or how wide a layer is."""


def numbers(components: tuple[type[Component], ...]) -> Iterator[tuple[str, str]]:
    """Component and option of every floating-point option, those of optimisers aside."""
    for component in components:
        if component.slot == "optimizer":
            continue
        for option, field in component.Config.model_fields.items():
            kinds = {field.annotation, *get_args(field.annotation)} - {NoneType}
            if float in kinds and option not in BEGINNINGS:
                yield component.name, option


@cache
def gaussians_of(overrides: tuple[str, ...]) -> Tensor:
    """What the model makes of two random photos; its weights follow from the seed alone."""
    model = compose(LOCUS, overrides).eval()
    with torch.random.fork_rng(devices=()), torch.no_grad():
        torch.manual_seed(0)
        c2w = torch.eye(4).repeat(1, 2, 1, 1)
        c2w[0, 1, 0, 3] = 0.3
        cameras = Cameras(c2w, torch.tensor([16.0, 16, 8, 8]).expand(1, 2, 4), (16, 16))
        prediction = model(Views(torch.rand(1, 2, 3, 16, 16), cameras))
    g = prediction.gaussians
    return torch.cat([g.means, g.scales, g.quats, g.opacities[..., None], g.colors], -1)


@pytest.mark.parametrize(("name", "paths", "default", "other", "beside"), LIMITS)
def test_a_limit_is_published_by_default_and_matters(
    name: str, paths: tuple[str, ...], default: float, other: float, beside: tuple[str, ...]
) -> None:
    published = gaussians_of(beside)
    spelled_out = [f"{path}={default!r}" for path in paths]
    changed = [f"{path}={other!r}" for path in paths]
    assert torch.equal(gaussians_of((*beside, *spelled_out)), published)
    assert not torch.equal(gaussians_of((*beside, *changed)), published)


def loss_value(kind: str, options: dict[str, Any]) -> Tensor:
    recipe = resolve({**LOCUS, "losses": {"loss": {"type": kind, **options}}})
    (loss,) = recipe.build_losses().values()
    z = torch.tensor([0.0, 5e-4, 0.01, 0.5, 1.0])
    points = torch.stack([torch.full_like(z, 0.3), torch.zeros_like(z), z], -1)[None]
    model = compose(LOCUS)
    state = model.queries.start(1)
    gaussians = model.decode(state)
    opaque = torch.linspace(0.1, 0.9, gaussians.count)[None]
    gaussians = type(gaussians)(
        points.expand(1, -1, 3).repeat(1, 4, 1)[:, : gaussians.count],
        gaussians.scales, gaussians.quats, opaque, gaussians.colors,
    )  # fmt: skip
    anchors = points.repeat(1, 2, 1)[:, :8]
    state = state.replace(fields={"anchor.center": anchors})
    images = torch.zeros(1, 1, 3, 16, 16)
    cameras = Cameras(torch.eye(4)[None, None], torch.tensor([[[16.0, 16, 8, 8]]]), (16, 16))
    rendering = Rendering(images, images[:, :, :1], images[:, :, :1])
    views = Views(images, cameras, depths=torch.full((1, 1, 1, 16, 16), 1.5))
    (term,) = loss(LayerPrediction(gaussians, state), rendering, views, views).values()
    return term.detach()


@pytest.mark.parametrize(("kind", "option", "default", "other", "beside"), LOSS_LIMITS)
def test_a_limit_of_a_loss_is_published_by_default_and_matters(
    kind: str, option: str, default: float, other: float, beside: dict[str, Any]
) -> None:
    published = loss_value(kind, beside)
    assert torch.equal(loss_value(kind, {**beside, option: default}), published)
    assert not torch.equal(loss_value(kind, {**beside, option: other}), published)


def test_no_limit_was_forgotten() -> None:
    walked = {(name, path.rpartition(".")[2]) for name, paths, *_ in LIMITS for path in paths}
    walked |= {(part.rpartition("/")[2], option) for part, option, *_ in LOSS_LIMITS}
    radius = {(name, "radius_min") for name in ("ray_biased", "refine", "radius_scaled")}
    assert set(numbers((*COMPONENTS, *LOSSES, *plugin.components))) == walked | radius


@pytest.mark.parametrize(
    ("recipe", "head", "centers"),
    [
        ("tokengs/dl3dv.yaml", (None, 1e-12), (None, None)),
        ("locus/dl3dv.yaml", (10.0, 1e-4), (100.0, 1000.0)),
    ],
)
def test_the_recipes_have_the_limits_of_their_releases(
    recipe: str, head: tuple[Any, ...], centers: tuple[Any, ...]
) -> None:
    model = resolve(RECIPES / recipe).tree["model"]
    assert (model["head"]["scale_input_limit"], model["head"]["quat_eps"]) == head
    assert (model["centers"]["input_limit"], model["centers"]["output_limit"]) == centers
