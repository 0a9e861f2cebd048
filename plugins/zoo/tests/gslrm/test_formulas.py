"""Every formula: encoder, rays, centres and head against what is written out by hand."""

import math
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from odd_views import in_tiles, odd_views
from qgs_zoo.gslrm.pixels import (
    PATCH,
    AlongRays,
    PixelHead,
    PixelQueries,
    Transformer,
    patch_rays_at,
)
from qgs_zoo.parts import pixel_rays
from small_parts import attended, made
from torch.testing import assert_close

from qgs.contracts import ModelDims
from qgs.geometry.rays import camera_rays
from qgs.types import Cameras, ImageMemory, QueryState

P = 4
"""Pixels along a patch."""
_, ROWS, COLUMNS = GRID = (3, 2, 3)
"""Views, and their patches."""


in_patches = partial(in_tiles, rows=P, columns=P)


def test_rays_of_a_patch_are_spread_evenly():
    """They are those of its pixels, or of pixels of another size where their number differs."""
    given = odd_views(3, 8, 12).cameras
    for count, rows, columns in ((16, 4, 4), (4, 2, 2), (2, 1, 2), (8, 2, 4), (3, 1, 3)):
        seen = patch_rays_at(pixel_rays(given, ROWS, COLUMNS), count)[1]
        factor = torch.tensor([columns / P, rows / P] * 2)
        fine = Cameras(given.c2w, given.intrinsics * factor, (rows * ROWS, columns * COLUMNS))
        assert_close(F.normalize(seen, dim=-1), in_tiles(camera_rays(fine)[1], rows, columns))


def test_means_lie_on_the_rays_of_their_pixels():
    """And gradients of what queries know of rays reach the cameras."""
    given = odd_views(3, 8, 12)
    memory = ImageMemory(torch.randn(2, 18, 16), grid=GRID)
    queries = made(PixelQueries)
    c2w = given.cameras.c2w.requires_grad_()
    state = queries(memory, given)
    assert state.features is memory.features
    assert queries.count is None
    offsets = torch.randn(2, 18, P * P, 3) * 3
    w = torch.sigmoid(offsets.sum(-1, keepdim=True) / 3)
    origins, directions = map(in_patches, camera_rays(given.cameras))
    ahead = c2w[..., :3, 2].repeat_interleave(6, 1)[:, :, None]
    slant = (directions * ahead).sum(-1, keepdim=True)
    for near, far in ((0.0, 500.0), (0.3, 3.0)):
        t = near * (1 - w) + far * w
        for options, along in (({}, t), ({"measure": "depth"}, t / slant)):
            placed = made(AlongRays, near=near, far=far, **options)(offsets, state)
            assert_close(placed, origins + along * directions)
    state[PATCH].sum().backward()
    assert c2w.grad[..., :3, :].any(-1).all()


def test_the_transformer_sees_nine_channels_of_every_pixel():
    encoder = made(Transformer, patch_size=P, depth=2, mlp_ratio=2.0, init_std=0.3)
    given = odd_views(3, 8, 12)
    origins, directions = camera_rays(given.cameras)
    colours = 2 * given.images.movedim(2, -1) - 1
    pixels = torch.cat([colours, torch.linalg.cross(origins, directions), directions], -1)
    x = F.layer_norm(encoder.embedding(in_patches(pixels).flatten(2)), (16,))
    for block in encoder.blocks:
        assert block.fc1.out_features == 32
        x = x + block.proj(attended(*block.qkv(F.layer_norm(x, (16,))).split(16, -1)))
        x = x + block.fc2(F.gelu(block.fc1(F.layer_norm(x, (16,)))))
    memory = encoder(given)
    assert_close(memory.features, x)
    assert memory.grid == GRID
    assert memory.keys is memory.values is None


def test_nothing_has_a_bias_and_weights_start_as_published():
    dims = ModelDims(width=128, heads=2, depth=0)
    for part in (made(Transformer, dims, depth=2), made(PixelHead, dims)):
        for name, parameter in part.named_parameters():
            matrix = parameter.ndim == 2
            assert not name.endswith("bias")
            assert part.decays(name, parameter) == matrix
            assert abs(parameter.mean() - int(not matrix)) <= 1e-3
            assert parameter.std().item() == pytest.approx(0.02 if matrix else 0, rel=0.05)


def test_the_head_follows_its_formulas():
    features = torch.randn(2, 7, 16)
    features[0, 0] = 0  # a rotation of zeros is none
    for channels, bias, limit, logit, options in (
        (3, -2.3, -1.2, -2.0, {}),
        (1, -2.3, -2.5, -2.0, {"scale_limit": -2.5}),
        (3, -4.0, 99, 1.0, {"scale_bias": -4.0, "scale_limit": None, "opacity_bias": 1.0}),
    ):
        options |= {"gaussians_per_query": 5, "position_channels": channels, "init_std": 1.0}
        head = made(PixelHead, **options)
        raw = head.linear(F.layer_norm(features, (16,))).view(2, 7, 5, channels + 11)
        position, rgb, scale, quats, opacity = raw.split((channels, 3, 3, 4, 1), -1)
        quats = F.normalize(quats, dim=-1)
        quats[0, 0] = torch.eye(4)[0]
        out = head(QueryState(features))
        found = (out.offsets, out.colors, out.scales, out.quats, out.opacities)
        colors = (0.5 + rgb / math.sqrt(4 * math.pi)).clip(0, 1)
        scale = (scale + bias).clip(max=limit).exp()
        opacity = (opacity[..., 0] + logit).sigmoid()
        assert_close(found, (position.expand(2, 7, 5, 3), colors, scale, quats, opacity))
