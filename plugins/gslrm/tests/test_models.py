"""Models with GS-LRM's parts: they run and learn, or are refused when composed, with the reason."""

from pathlib import Path
from typing import Any

import pytest
import torch
from qgs_gslrm.pixels import AlongRays
from qgs_plugintools import Case
from qgs_plugintools.checks.fields import run_training_step
from refusals import refused

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
    "one for 2 x 2 pixels": {"head": {"type": "gslrm/pixel_head", "gaussians_per_query": 16}},
    "TokenGS's encoder and decoder": {"encoder": ENCODERS["vit"], "decoder": {"depth": 1}},
    "LocusGS with GS-LRM's head": {
        "encoder": ENCODERS["multiscale"],
        "queries": ANCHORS,
        "decoder": {"depth": 1, "cross_attention": {"type": "locus/ray_biased"}},
        "centers": {"type": "locus/radius_scaled"},
    },
}


@pytest.mark.parametrize("name", RUNNING)
def test_a_combination_runs(name: str) -> None:
    run_training_step(resolve(recipe(**RUNNING[name])), Case(AlongRays.Config()))


@pytest.mark.parametrize(
    ("model", "option"),
    [
        ({"decoder": {"depth": 1}}, "model.decoder.cross_attention"),  # no keys
        ({"queries": ANCHORS}, "model.centers"),  # no patches
        ({"centers": {"type": "gslrm/along_rays", "near": 4.0, "far": 0.5}}, "model.centers.far"),
    ],
)
def test_what_cannot_work_is_refused(model: dict[str, Any], option: str) -> None:
    assert refused(recipe(**model)).option == option


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
