"""Models with GS-LRM's parts: they run and learn, or are refused when composed, with the reason."""

from pathlib import Path
from typing import Any

import pytest
import torch
from qgs_gslrm.pixels import AlongRays
from qgs_plugintools import Case
from qgs_plugintools.checks.fields import run_training_step
from refusals import refused

import qgs
from qgs.composer import resolve
from qgs.types import Cameras, Views

RECIPES = Path(__file__).parents[3] / "recipes"
ENCODERS = {
    "gslrm": {"type": "gslrm/transformer", "patch_size": 8, "depth": 1},
    "vit": {"type": "qgs/multiview_vit", "patch_size": 8, "depth": 1},
    "multiscale": {
        "type": "tokengs2026/multiscale_vit",
        "patch_size": 8,
        "depth": 1,
        "blocks": [1],
    },
}
NO_LAYERS = {"depth": 0}
ANCHORS = {"type": "locus/anchored", "count": 6}


def recipe(**model: Any) -> dict[str, Any]:
    parts = {
        "width": 32,
        "heads": 2,
        "encoder": ENCODERS["gslrm"],
        "queries": {"type": "gslrm/pixels"},
        "decoder": NO_LAYERS,
        "head": {"type": "gslrm/pixel_head"},
        "centers": {"type": "gslrm/along_rays", "near": 0.5, "far": 4.0},
        "supervision": {"layers": [model.get("decoder", NO_LAYERS)["depth"]]},
        "renderer": {"type": "qgs/torch"},
    }
    losses = {"photometric": {"type": "qgs/photometric"}}
    plugins = ["gslrm", "locus", "tokengs2026"]
    return {"recipe": 1, "plugins": plugins, "model": {**parts, **model}, "losses": losses}


RUNNING = {
    "GS-LRM": {},
    "one channel": {"head": {"type": "gslrm/pixel_head", "position_channels": 1}},
    "one for 2 x 2 pixels": {"head": {"type": "gslrm/pixel_head", "gaussians_per_query": 16}},
    "TokenGS's head": {"head": {"type": "qgs/gaussian_head", "gaussians_per_query": 3}},
    "TokenGS's centres": {"centers": {"type": "qgs/free"}},
    "TokenGS's encoder": {"encoder": ENCODERS["vit"]},
    "TokenGS's encoder and decoder": {"encoder": ENCODERS["vit"], "decoder": {"depth": 1}},
    "multiscale encoder": {"encoder": ENCODERS["multiscale"]},
    "GS-LRM's head of TokenGS": {
        "encoder": ENCODERS["vit"],
        "queries": {"type": "qgs/latent", "count": 5},
        "decoder": {"depth": 1},
        "centers": {"type": "qgs/free"},
    },
    "GS-LRM's head of LocusGS": {
        "encoder": ENCODERS["multiscale"],
        "queries": ANCHORS,
        "decoder": {"depth": 1, "cross_attention": {"type": "locus/ray_biased"}},
        "centers": {"type": "locus/radius_scaled"},
    },
}


@pytest.mark.parametrize("name", RUNNING)
def test_a_combination_runs(name: str) -> None:
    run_training_step(resolve(recipe(**RUNNING[name])), Case(AlongRays.Config()))


LATENTS = {"type": "tokengs2026/latent_bottleneck", "depth": 1, "blocks": [1], "latents": 5}
KEYS = "needs memory.keys (D/h float32) and memory.values (D/h float32)"
REFUSED = {
    "a decoder without keys": ({"decoder": {"depth": 1}}, f"`qgs/content` {KEYS}"),
    "latents, which are no patches": (
        {"encoder": LATENTS},
        "`gslrm/pixels` needs memory.grid (3 int64)",
    ),
    "features of another width": (
        {"encoder": {**ENCODERS["multiscale"], "depth": 2, "blocks": [1, 2]}},
        "`gslrm/pixels` reads memory.features as D float32, `tokengs2026/multiscale_vit`",
    ),
    "LocusGS's centres": (
        {"centers": {"type": "locus/radius_scaled"}},
        "`locus/radius_scaled` needs anchor.center",
    ),
    "LocusGS's attention": (
        {
            "encoder": ENCODERS["vit"],
            "decoder": {"depth": 1, "cross_attention": {"type": "locus/ray_biased"}},
        },
        "`locus/ray_biased` needs anchor.center",
    ),
    "LocusGS's queries": ({"queries": ANCHORS}, "`gslrm/along_rays` needs gslrm.patch (4x3"),
    "a scene that ends before it begins": (
        {"centers": {"type": "gslrm/along_rays", "near": 4.0, "far": 0.5}},
        "far must be beyond near, got near 4 and far 0.5",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_combination_is_refused_with_the_reason(name: str) -> None:
    parts, reason = REFUSED[name]
    assert reason in refused(recipe(**parts)).reason


def test_patches_must_divide_the_images() -> None:
    data = {"type": "rooms/procedural", "image_size": [60, 64]}
    given = {**recipe(), "plugins": ["gslrm", "rooms"], "data": data}
    problem = refused(given)
    assert problem.option == "model.encoder.patch_size"
    assert "patches of 8 do not divide images of 60 x 64 (H x W)" in problem.reason
    assert "set data.image_size to [64, 64]" in problem.fix
    model = resolve(recipe()).build_model()
    with pytest.raises(ValueError, match="images of 60 x 64 cannot be cut into patches of 8"):
        model(photos(size=(60, 64)))


def photos(views: int = 2, size: tuple[int, int] = (32, 32)) -> Views:
    """Noise pictures of a smooth kind, from cameras side by side."""
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(views, 3, 4, 4, generator=generator)
    images = torch.nn.functional.interpolate(coarse, size, mode="bilinear")[None]
    c2w = torch.eye(4).repeat(1, views, 1, 1)
    c2w[0, :, 0, 3] = 0.1 * torch.arange(views)
    lens = torch.tensor([size[1], size[1], size[1] / 2, size[0] / 2]).expand(1, views, 4)
    return Views(images, Cameras(c2w, lens, size))


@pytest.mark.parametrize("views", [1, 3])
def test_there_is_a_gaussian_for_each_pixel_in_the_view_of_its_camera(views: int) -> None:
    model, given = resolve(recipe()).build_model().eval(), photos(views)
    gaussians = model(given).gaussians
    assert gaussians.count == views * 32 * 32
    for view in range(views):
        own = (
            gaussians[:, view * 1024 : (view + 1) * 1024].means - given.cameras.c2w[:, view, :3, 3]
        )
        x, y = (own[0, :, i] / own[0, :, 2] * 32 + 16 for i in (0, 1))
        places = torch.stack([x, y], -1).detach()
        row, column = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")
        pixels = torch.stack([column, row], -1) + 0.5
        by_patch = pixels.view(4, 8, 4, 8, 2).transpose(1, 2).reshape(-1, 2)
        torch.testing.assert_close(places, by_patch, atol=1e-2, rtol=0)


def test_it_learns() -> None:
    torch.manual_seed(0)
    sizes = {"encoder": {**ENCODERS["gslrm"], "patch_size": 4}}
    head = {"type": "gslrm/pixel_head", "gaussians_per_query": 16}
    head |= {"scale_bias": -3.0, "opacity_bias": 2.0}
    model = resolve(recipe(**sizes, head=head)).build_model().train()
    given, losses = photos(size=(16, 16)), []
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for _ in range(60):
        rendered = model.render(model(given).gaussians, given.cameras).rgb
        loss = (rendered - given.images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.4 * losses[0], losses


def test_the_tiny_recipe_has_the_budget_of_the_others() -> None:
    ours, theirs = (
        qgs.compose(RECIPES / f"tiny/{n}.yaml", device="meta") for n in ("gslrm", "locus")
    )
    counts = [sum(p.numel() for p in model.parameters()) for model in (ours, theirs)]
    assert counts[0] == pytest.approx(counts[1], rel=0.1)
    assert 2 * (64 // 8) ** 2 * ours.head.gaussians_per_query == 2_048
    for section in ("data", "views", "optimizer", "training", "evaluation"):
        assert ours.recipe[section] == theirs.recipe[section]
