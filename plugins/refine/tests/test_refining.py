"""Refinement brings Gaussians nearer to the photos of their scene; the clock is a fake."""

import math
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import pytest
import torch
from qgs_refine.growth import DEAD, FreeGaussians
from qgs_refine.refining import mean_psnr, resized

import qgs
from qgs.geometry.poses import look_at
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Gaussians, Views, map_tensors

RENDERER = AutoRenderer(AutoRenderer.Config())
RATES: dict[str, float] = dict.fromkeys(
    ("means", "log_scales", "quats", "opacity_logits", "color_logits", "colors", "sh"), 1e-2
)


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[int], Any]], None]:
    """Every step takes a second; a function given to this is called at each reading."""
    hooks: list[Callable[[int], Any]] = []
    readings = count()

    def read() -> float:
        now = next(readings)
        for hook in hooks:
            hook(now)
        return float(now)

    monkeypatch.setattr("qgs_refine.refining.perf_counter", read)
    return hooks.append


def cloud(number: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    means = 0.3 * torch.randn(1, number, 3, generator=generator)
    scales = 0.05 + 0.1 * torch.rand(1, number, 3, generator=generator)
    quats = torch.nn.functional.normalize(torch.randn(1, number, 4, generator=generator), dim=-1)
    opacities = 0.3 + 0.6 * torch.rand(1, number, generator=generator)
    return Gaussians(means, scales, quats, opacities, torch.rand(1, number, 3, generator=generator))


def ring(views: int, side: int = 24) -> Cameras:
    """Cameras (1, views) on a quarter of a circle of radius 2 about the origin."""
    angles = torch.linspace(0, math.pi / 2, views)
    eyes = 2 * torch.stack([angles.sin(), 0 * angles, -angles.cos()], -1)
    c2w = look_at(eyes, -eyes, torch.tensor([0.0, 1, 0]).expand(views, 3))
    middle = [side / 2, side / 2]
    intrinsics = torch.tensor([side, side, *middle]).float().expand(1, views, 4)
    return Cameras(c2w[None], intrinsics, (side, side))


@pytest.fixture(scope="module")
def scene() -> tuple[Views, Views]:
    """Photos of a cloud of 60 Gaussians to optimise on, and others between them."""
    cameras = ring(9)
    images = RENDERER(cloud(60), cameras).rgb.clamp(0, 1)
    every = Views(images, cameras)
    return every.select([0, 1, 3, 4, 5, 7, 8]), every.select([2, 6])


def test_photos_that_are_not_optimised_on_are_met_better(scene: tuple[Views, Views]) -> None:
    photos, compared = scene
    start = cloud(40, seed=1)
    before = start.means.clone()
    result, again = (qgs.refine(start, photos, 150, compared=compared) for _ in range(2))
    assert torch.equal(result.gaussians.means, again.gaussians.means)
    assert torch.equal(start.means, before)
    assert result.steps == 150  # the first, in which kernels compile, is not counted; the sweep is
    assert result.curve[0].psnr == pytest.approx(mean_psnr(start, compared, RENDERER), abs=0.3)
    assert result.curve[-1].psnr > result.curve[0].psnr + 6
    final = mean_psnr(result.gaussians, compared, RENDERER)
    assert final == pytest.approx(result.curve[-1].psnr)
    assert [point.seconds for point in result.curve] == sorted(p.seconds for p in result.curve)
    assert not result.gaussians.means.requires_grad
    norms = result.gaussians.quats.norm(dim=-1)
    torch.testing.assert_close(norms, torch.ones_like(norms))


@pytest.mark.parametrize("wanted", [90, 12, 30])
def test_there_are_as_many_as_wanted(scene: tuple[Views, Views], wanted: int) -> None:
    start = cloud(30)
    result = qgs.refine(start, scene[0], 200, count=wanted)
    assert result.gaussians.count == wanted
    if wanted < 30:
        two_steps = qgs.refine(start, scene[0], 1.5, count=wanted).gaussians.opacities
        kept = start.opacities.topk(wanted // 2).values
        torch.testing.assert_close(two_steps[:, : wanted // 2], kept, atol=0.06, rtol=0)


def test_harmonics_are_refined_and_features_kept(scene: tuple[Views, Views]) -> None:
    """New Gaussians start with none of both, copies with those of their parents."""
    photos, compared = scene
    start = cloud(30)
    marks = torch.arange(1.0, 31)[None, :, None]
    start = replace(start, sh=torch.zeros(1, 30, 8, 3), features=marks)
    result = qgs.refine(start, photos, 120, count=50, compared=compared).gaussians
    assert result.sh is not None
    assert result.sh.shape == (1, 50, 8, 3)
    assert result.sh.abs().max() > 1e-3
    assert {*result.features.flatten().tolist()} <= {*range(31)}
    kept = start.most_opaque(15).features
    assert (result.features == kept[0, 0, 0]).any()
    plain = qgs.refine(cloud(30), photos, 20, count=50).gaussians
    assert plain.sh is None
    assert plain.features is None


def test_an_interrupt_keeps_what_there_is(
    scene: tuple[Views, Views], clock: Callable[[Callable[[int], Any]], None]
) -> None:
    clock(lambda now: os.kill(os.getpid(), signal.SIGINT) if now == 11 else None)
    result = qgs.refine(cloud(30), scene[0], 1000)
    assert result.stopped_by == "SIGINT"
    assert result.steps == 6  # that of the twelfth reading is finished
    assert result.gaussians.count == 30


def test_a_coarser_level_shows_the_same_scene() -> None:
    cameras = ring(3, side=64)
    fine = RENDERER(cloud(20), cameras).rgb
    given = Views(fine, cameras, fine[:, :, :1], torch.rand(1, 3), torch.rand(1, 1))
    coarse = resized(given, 2)
    assert coarse.images.shape == (1, 3, 3, 32, 32)
    assert coarse.masks is not None
    assert torch.equal(coarse.masks, coarse.images[:, :, :1])
    assert coarse.times is given.times
    assert coarse.target_time is given.target_time
    assert mean_psnr(cloud(20), coarse, RENDERER) > 32


BROKEN = map_tensors(lambda x: x * math.nan, cloud(4))
TWO_SCENES = map_tensors(lambda x: x.expand(2, *x.shape[1:]), cloud(4))


@pytest.mark.parametrize(
    ("gaussians", "photos", "options"),
    [
        (TWO_SCENES, [0, 1], {}),
        (cloud(4), [], {}),
        (cloud(4), [0, 1], {"seconds": 0}),
        (cloud(4), [0, 1], {"count": 0}),
        (BROKEN, [0, 1], {}),
    ],
    ids=["two scenes", "no photo", "no time", "no Gaussians", "nan"],
)
def test_unusable_input_is_refused(
    gaussians: Gaussians, photos: list[int], options: dict[str, Any]
) -> None:
    views = Views(torch.rand(1, 2, 3, 24, 24), ring(2)).select(photos)
    with pytest.raises(ValueError, match="Gaussians"):
        qgs.refine(gaussians, views, **{"seconds": 1, **options})


def test_moments_follow_their_gaussians() -> None:
    """After growth every Gaussian that was not touched learns on as before."""
    start = cloud(40)
    opacities = start.opacities.clone()
    opacities[0, :5] = DEAD / 5
    opacities[0, 5:] = 0.1
    opacities[0, 7] = 0.99  # drawn more often
    free = FreeGaussians(replace(start, opacities=opacities), RATES)
    loss = free.gaussians().means.sum() + free.gaussians().opacities.sum()
    loss.backward()
    free.optimizer.step()
    before = {name: value.detach().clone() for name, value in free.values.items()}
    free.grow(44, torch.Generator().manual_seed(0))
    assert free.count == 44
    moved = [i for i in range(40) if not torch.equal(free.values["means"][i], before["means"][i])]
    assert moved == [0, 1, 2, 3, 4]
    assert (free.values["opacity_logits"].sigmoid() >= DEAD - 1e-6).all()
    (group,) = (g for g in free.optimizer.param_groups if g["name"] == "means")
    assert group["params"][0] is free.values["means"]
    moments = free.optimizer.state[group["params"][0]]["exp_avg"]
    assert moments.shape == (44, 3)
    assert (moments[[0, 1, 2, 3, 4, 40, 41, 42, 43]] == 0).all()
    assert (moments[5:40] != 0).any()
    free.gaussians().means.sum().backward()
    free.optimizer.step()


def test_colors_beside_harmonics_may_have_any_value() -> None:
    colors, sh = torch.linspace(-0.7, 1.6, 60).reshape(1, 20, 3), torch.zeros(1, 20, 3, 3)
    free = FreeGaussians(replace(cloud(20), colors=colors, sh=sh), RATES)
    assert torch.equal(free.gaussians().colors, colors)
    free.grow(24, torch.Generator().manual_seed(0))
    assert torch.equal(free.gaussians().colors[:, :20], colors)
    free.gaussians().colors.sum().backward()
    free.optimizer.step()
    assert (free.gaussians().colors[:, :20] < colors).all()


def test_where_none_is_alive_none_is_moved() -> None:
    start = cloud(6)
    free = FreeGaussians(replace(start, opacities=0 * start.opacities), RATES)
    before = free.values["means"].detach().clone()
    free.grow(9, torch.Generator())
    assert free.count == 9
    assert torch.equal(free.values["means"][:6], before)


def test_growth_free_the_rendering_as_it_is(scene: tuple[Views, Views]) -> None:
    """Also of fog, Gaussians that are all faint, of which many copies are made at once."""
    photos, _ = scene
    start = cloud(200)
    fog = 0.01 + 0.05 * torch.rand(1, 200, generator=torch.Generator().manual_seed(1))
    free = FreeGaussians(
        Gaussians(start.means, start.scales, start.quats, fog, start.colors), RATES
    )
    before = RENDERER(free.gaussians(), photos.cameras).rgb.detach()
    free.grow(400, torch.Generator().manual_seed(0))
    after = Views(before, photos.cameras)
    assert mean_psnr(free.gaussians(), after, RENDERER) > 35
