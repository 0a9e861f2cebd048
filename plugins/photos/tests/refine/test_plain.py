"""Colours without harmonics are those that photos see."""

from dataclasses import replace

import torch
from qgs_photos.refine.result import plain
from test_refining import RENDERER, cloud, ring


def coloured():
    return replace(cloud(60), sh=0.3 * torch.randn(1, 60, 3, 3))


def test_one_photo_is_rendered_as_with_harmonics():
    gaussians = coloured()
    cameras = ring(1, 48)
    found = plain(gaussians, cameras)
    assert found.sh is None
    full, same, flat = (
        RENDERER(g, cameras).rgb for g in (gaussians, found, replace(gaussians, sh=None))
    )
    assert torch.allclose(same, full, 0, 1e-4)
    assert (flat - full).abs().max() > 0.05


def test_photos_that_do_not_show_a_gaussian_do_not_count():
    gaussians = coloured()
    cameras = ring(2, 48)
    away = cameras.c2w.clone()
    away[:, 1, :3, [0, 2]] *= -1
    one = plain(gaussians, cameras[:, :1]).colors
    alike = (plain(gaussians, replace(cameras, c2w=away)).colors - one).abs().amax(-1) < 1e-5
    assert alike.float().mean() > 0.95  # but for those that no photo shows
    assert not torch.allclose(plain(gaussians, cameras).colors, one, atol=0.01)
