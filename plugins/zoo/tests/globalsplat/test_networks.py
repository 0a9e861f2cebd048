"""Memory tokens and both streams at the start, channel by channel; a round by its sums."""

import math

import pytest
import torch
from odd_views import odd_views
from qgs_zoo.globalsplat.encoder import PosedPatches
from qgs_zoo.globalsplat.streams import TEXTURE, Round, SlotQueries
from small_parts import DIMS, attended, made, shaken
from tables import assert_equal
from torch.nn.functional import gelu
from torch.testing import assert_close

from qgs.contracts import LayerParts
from qgs.geometry.rays import plucker_rays
from qgs.types import ImageMemory, QueryState


def test_a_token_is_its_colours_beside_its_rays_and_its_camera():
    encoder = made(PosedPatches, patch_size=4, rgb_width=6, ray_width=5, lens_width=3, bands=2)
    given = odd_views(2, 16, 24)
    memory = encoder(given)
    assert memory.features.shape == (2, 2 * 4 * 6 + 4, 11)
    assert memory.grid is memory.keys is memory.patch_rays is None
    assert_equal(memory.features[0, -4:], encoder.registers)
    # scene 1, view 1, row 2, column 3
    token = memory.features[1, 24 + 2 * 6 + 3]
    patch = (1, 1, slice(None), slice(8, 12), slice(12, 16))
    assert_close(token[:6], encoder.rgb_embedding(2 * given.images[patch] - 1).flatten())
    rays = encoder.ray_embedding(plucker_rays(given.cameras)[patch]).flatten()
    fx, fy, cx, cy = given.cameras.intrinsics[1, 1].tolist()
    told = torch.tensor([math.log(fx / 24), math.log(fy / 16), cx / 24, cy / 16])
    x = given.cameras.c2w[1, 1, :3, 3]
    waves = [f(k * math.pi * x) for f in (torch.sin, torch.cos) for k in (1, 2)]
    camera = torch.cat([encoder.lens_mlp(told), x, *waves])
    assert_close(token[6:], rays + encoder.camera_proj(camera))


def test_two_streams_of_one_token():
    queries = made(SlotQueries, count=400, extra=4, std=0.5)
    assert queries.slots.std().item() == pytest.approx(0.5, rel=0.05)
    state = queries(ImageMemory(torch.zeros(3, 1, 7)), odd_views(2, 16, 24))
    tokens = torch.cat([queries.slots, queries.extra])
    for stream, seen in ((queries.geometry, state.features), (queries.texture, state[TEXTURE])):
        assert_close(seen, stream(tokens).expand(3, -1, -1))
    assert_equal(state.mask, torch.arange(400).expand(3, -1) < 396)
    assert made(SlotQueries, count=4, extra=0).start(2).mask is None


def mlp(x, layers):
    return layers.fc2(gelu(layers.fc1(x)))


def one_stream(stream, x, memory):
    cross = stream.cross_attention
    k, v = stream.kv_proj(stream.memory_norm(memory)).chunk(2, -1)
    read = attended(cross.q_proj(cross.norm(x)), k, v, cross.q_norm, stream.k_norm)
    x = x + stream.cross_scale.gamma * cross.out_proj(read)
    x = x + stream.mlp_scale.gamma * mlp(stream.norm(x), stream.mlp)
    for block in stream.blocks:
        core = block.attention
        read = attended(*core.qkv(block.norm1(x)).chunk(3, -1), core.q_norm, core.k_norm)
        x = x + block.scale1.gamma * core.proj(read)
        x = x + block.scale2.gamma * mlp(block.norm2(x), block.mlp)
    return x


def test_a_round_is_two_streams_and_a_mixer():
    """Tokens that decode nothing are read as well."""
    layer = shaken(made(Round, LayerParts(DIMS, {}, 0.5), memory_width=10))
    memory = ImageMemory(torch.randn(2, 7, 10).double())
    x, y = torch.randn(2, 2, 5, 16).double()
    state = QueryState(x, {TEXTURE: y}, torch.tensor([True] * 4 + [False]).expand(2, -1))
    after, passed = layer(state, memory)
    assert passed is memory
    assert after.mask is state.mask
    x = one_stream(layer.geometry, x, memory.features)
    y = one_stream(layer.texture, y, memory.features)
    both = torch.cat([layer.geometry_norm(x), layer.texture_norm(y)], -1)
    update = layer.mixer_scale.gamma * mlp(both, layer.mixer)
    assert_close(after.features, x + update[..., :16])
    assert_close(after[TEXTURE], y + update[..., 16:])
