"""Every formula: encoder, rays, centres and head against what is written out by hand."""

import math

import pytest
import torch
import torch.nn.functional as F
from qgs_gslrm.encoder import Transformer
from qgs_gslrm.pixels import PATCH, AlongRays, PixelHead, PixelQueries, patch_rays_at, patches
from torch import Tensor

from qgs.contracts import ModelDims
from qgs.geometry.rays import camera_rays
from qgs.types import Cameras, ImageMemory, QueryState, Views

DIMS = ModelDims(width=16, heads=2, depth=0)
VIEWS, SIZE, P = 3, (8, 12), 4
ROWS, COLUMNS = SIZE[0] // P, SIZE[1] // P


def cameras(scenes: int = 2) -> Cameras:
    """Turned by some angle about y and moved, with unequal focal lengths, off centre."""
    turn = torch.linspace(-0.5, 0.4, scenes * VIEWS, dtype=torch.float64).view(scenes, VIEWS)
    c2w = torch.eye(4, dtype=torch.float64).repeat(scenes, VIEWS, 1, 1)
    c2w[..., 0, 0] = c2w[..., 2, 2] = turn.cos()
    c2w[..., 0, 2], c2w[..., 2, 0] = turn.sin(), -turn.sin()
    generator = torch.Generator().manual_seed(0)
    c2w[..., :3, 3] = torch.randn(scenes, VIEWS, 3, generator=generator, dtype=torch.float64)
    lens = torch.tensor([9.0, 11.0, 5.5, 4.5], dtype=torch.float64).expand(scenes, VIEWS, 4)
    return Cameras(c2w, lens, SIZE)


def views() -> Views:
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(2, VIEWS, 3, *SIZE, generator=generator, dtype=torch.float64)
    return Views(images, cameras())


def in_patches(maps: Tensor) -> Tensor:
    """(B, V, H, W, C) -> (B, N, P * P, C), one patch after the other, by loops."""
    found = []
    for view in range(VIEWS):
        for row in range(0, SIZE[0], P):
            for column in range(0, SIZE[1], P):
                patch = maps[:, view, row : row + P, column : column + P]
                found.append(patch.reshape(len(maps), P * P, -1))
    return torch.stack(found, 1)


def queried() -> QueryState:
    grid = (VIEWS, ROWS, COLUMNS)
    features = torch.randn(2, math.prod(grid), DIMS.width)
    return PixelQueries(PixelQueries.Config(), DIMS)(ImageMemory(features, grid=grid), views())


def test_a_patch_knows_the_rays_of_its_pixels() -> None:
    origins, directions = camera_rays(cameras())
    o, d = patch_rays_at(patches(cameras(), ROWS, COLUMNS), P * P)
    torch.testing.assert_close(F.normalize(d, dim=-1), in_patches(directions))
    torch.testing.assert_close(o.expand_as(d), in_patches(origins))


@pytest.mark.parametrize(("count", "rows", "columns"), [(4, 2, 2), (2, 1, 2), (8, 2, 4), (3, 1, 3)])
def test_another_number_of_gaussians_is_spread_evenly(count: int, rows: int, columns: int) -> None:
    """Their rays are those of a camera with pixels of another size."""
    seen = F.normalize(patch_rays_at(patches(cameras(), ROWS, COLUMNS), count)[1], dim=-1)
    fine = rows * ROWS, columns * COLUMNS
    factor = torch.tensor([fine[1] / SIZE[1], fine[0] / SIZE[0]] * 2, dtype=torch.float64)
    given = cameras()
    directions = camera_rays(Cameras(given.c2w, given.intrinsics * factor, fine))[1]
    parts = directions.reshape(2, VIEWS, ROWS, rows, COLUMNS, columns, 3).transpose(3, 4)
    torch.testing.assert_close(seen, parts.reshape(2, -1, count, 3))


def test_queries_are_the_tokens_and_their_gradients_reach_the_cameras() -> None:
    given = views()
    c2w = given.cameras.c2w.clone().requires_grad_()
    moved = Views(given.images, Cameras(c2w, given.cameras.intrinsics, SIZE))
    features = torch.randn(2, VIEWS * ROWS * COLUMNS, DIMS.width)
    queries = PixelQueries(PixelQueries.Config(), DIMS)
    state = queries(ImageMemory(features, grid=(VIEWS, ROWS, COLUMNS)), moved)
    assert state.features is features
    assert queries.count is None
    state[PATCH].sum().backward()
    assert c2w.grad is not None
    assert c2w.grad[..., :3, :].any(-1).all()


@pytest.mark.parametrize(("near", "far"), [(0.0, 500.0), (0.3, 3.0)])
def test_means_lie_on_the_rays_of_their_pixels(near: float, far: float) -> None:
    offsets = torch.randn(2, VIEWS * ROWS * COLUMNS, P * P, 3, dtype=torch.float64) * 3
    means = AlongRays(AlongRays.Config(near=near, far=far), DIMS)(offsets, queried())
    origins, directions = map(in_patches, camera_rays(cameras()))
    w = 1 / (1 + torch.exp(-offsets.sum(-1, keepdim=True) / 3))
    torch.testing.assert_close(means, origins + (near * (1 - w) + far * w) * directions)
    distance = (means - origins).norm(dim=-1)
    assert distance.min() > near
    assert distance.max() < far
    deep = AlongRays(AlongRays.Config(near=near, far=far, measure="depth"), DIMS)
    placed = deep(offsets, queried()).unflatten(1, (VIEWS, -1)).flatten(2, 3)
    local = cameras().w2c[..., :3, :] @ F.pad(placed, (0, 1), value=1.0).mT
    depth = (near * (1 - w) + far * w).unflatten(1, (VIEWS, -1)).flatten(2, 3)
    torch.testing.assert_close(local[..., 2, :], depth[..., 0])


def test_the_embedding_sees_nine_channels_of_every_pixel() -> None:
    encoder = Transformer(Transformer.Config(patch_size=P, depth=0), DIMS).double()
    given = views()
    origins, directions = camera_rays(given.cameras)
    colours = 2 * given.images.movedim(2, -1) - 1
    pixels = torch.cat([colours, torch.linalg.cross(origins, directions), directions], -1)
    raw = in_patches(pixels).flatten(2) @ encoder.embedding.weight.T
    centred = raw - raw.mean(-1, keepdim=True)
    expected = centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt()
    memory = encoder(given)
    torch.testing.assert_close(memory.features, expected)
    assert memory.grid == (VIEWS, ROWS, COLUMNS)
    assert memory.keys is None
    assert memory.values is None


def test_a_block_is_attention_and_mlp_before_which_is_a_norm() -> None:
    config = Transformer.Config(patch_size=P, depth=1, mlp_ratio=2.0, init_std=0.3)
    encoder = Transformer(config, DIMS).double()
    block = encoder.blocks[0]
    embedded = Transformer(Transformer.Config(patch_size=P, depth=0), DIMS).double()
    embedded.load_state_dict({n: x for n, x in encoder.state_dict().items() if "blocks" not in n})
    x = embedded(views()).features
    y = F.layer_norm(x, (16,)) @ block.qkv.weight.T
    read = torch.zeros_like(x)
    for head in range(2):
        q, k, v = (y[..., 16 * part + 8 * head :][..., :8] for part in range(3))
        weights = (q @ k.mT / math.sqrt(8)).softmax(-1)
        read[..., 8 * head : 8 * head + 8] = weights @ v
    x = x + read @ block.proj.weight.T
    hidden = F.layer_norm(x, (16,)) @ block.fc1.weight.T
    gelu = hidden * (1 + torch.erf(hidden / math.sqrt(2))) / 2
    torch.testing.assert_close(encoder(views()).features, x + gelu @ block.fc2.weight.T)


def test_nothing_has_a_bias_and_weights_start_as_published() -> None:
    dims = ModelDims(width=128, heads=2, depth=0)
    parts = (Transformer(Transformer.Config(depth=2), dims), PixelHead(PixelHead.Config(), dims))
    for part in parts:
        for name, parameter in part.named_parameters():
            assert not name.endswith("bias")
            assert part.decays(name, parameter) == (parameter.ndim == 2)
            if parameter.ndim == 2:
                assert parameter.std().item() == pytest.approx(0.02, rel=0.05)
                assert abs(parameter.mean().item()) < 1e-3
            else:
                assert parameter.eq(1).all()


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(
    "options",
    [{}, {"scale_bias": -4.0, "scale_limit": None, "opacity_bias": 1.0}, {"scale_limit": -2.5}],
)
def test_the_head_follows_its_formulas(channels: int, options: dict) -> None:
    config = PixelHead.Config(
        gaussians_per_query=5, position_channels=channels, init_std=1.0, **options
    )
    head, features = PixelHead(config, DIMS), torch.randn(2, 7, DIMS.width)
    raw = F.layer_norm(features, (16,)) @ head.linear.weight.T
    raw = raw.view(2, 7, 5, channels + 11)
    out, after = head(QueryState(features)), raw[..., channels:]
    assert torch.equal(out.offsets, raw[..., :channels].expand(2, 7, 5, 3))
    torch.testing.assert_close(
        out.colors, (0.5 + after[..., :3] / math.sqrt(4 * math.pi)).clip(0, 1)
    )
    log_scales = after[..., 3:6] + options.get("scale_bias", -2.3)
    limit = options.get("scale_limit", -1.2)
    log_scales = log_scales if limit is None else log_scales.minimum(torch.tensor(limit))
    torch.testing.assert_close(out.scales, log_scales.exp())
    quats = after[..., 6:10]
    torch.testing.assert_close(out.quats, quats / quats.square().sum(-1, keepdim=True).sqrt())
    bias = options.get("opacity_bias", -2.0)
    torch.testing.assert_close(out.opacities, 1 / (1 + torch.exp(-after[..., 10] - bias)))
    assert head.gaussians_per_query == 5


def test_a_rotation_of_zeros_is_none() -> None:
    out = PixelHead(PixelHead.Config(gaussians_per_query=1), DIMS)(
        QueryState(torch.zeros(1, 2, 16))
    )
    assert torch.equal(out.quats[0, 1, 0], torch.tensor([1.0, 0.0, 0.0, 0.0]))
    assert out.scales.allclose(torch.tensor(math.exp(-2.3)))
    assert out.colors.eq(0.5).all()
