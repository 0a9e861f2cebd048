"""Colours without harmonics are those that photos see."""

from dataclasses import replace

import torch
from qgs_refine.plain import plain
from test_refining import RENDERER, cloud, ring

from qgs.types import Cameras, Gaussians


def coloured(count: int) -> Gaussians:
    sh = 0.3 * torch.randn(1, count, 3, 3, generator=torch.manual_seed(0))
    return replace(cloud(count), sh=sh)


def test_one_photo_is_rendered_as_with_harmonics() -> None:
    gaussians, cameras = coloured(60), ring(1, 48)
    found = plain(gaussians, cameras)
    assert found.sh is None
    full, same, flat = (
        RENDERER(g, cameras).rgb for g in (gaussians, found, replace(gaussians, sh=None))
    )
    torch.testing.assert_close(same, full, atol=1e-4, rtol=0)
    assert (flat - full).abs().max() > 0.05


def test_photos_that_do_not_show_a_gaussian_do_not_count() -> None:
    gaussians, cameras = coloured(60), ring(2, 48)
    away = cameras.c2w.clone()
    away[:, 1, :3, :3] = away[:, 1, :3, :3] @ torch.diag(torch.tensor([-1.0, 1, -1]))
    turned = Cameras(away, cameras.intrinsics, cameras.size)
    one = plain(gaussians, cameras[:, :1])
    alike = (plain(gaussians, turned).colors - one.colors).abs().amax(-1) < 1e-5
    assert alike.float().mean() > 0.95  # but for those that no photo shows
    assert not torch.allclose(plain(gaussians, cameras).colors, one.colors, atol=0.01)
