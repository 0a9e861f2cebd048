"""A round against the same sums written without a module of qgs."""

import torch
import torch.nn.functional as F
from globalsplat_inputs import DIMS, lively, state
from qgs_globalsplat.streams import TEXTURE, Round, Stream
from torch import Tensor, nn

from qgs.contracts import LayerParts
from qgs.types import ImageMemory, QueryState

HEADS, EACH = 2, 8


def normed(x: Tensor, norm: nn.LayerNorm) -> Tensor:
    mean, var = x.mean(-1, keepdim=True), x.var(-1, correction=0, keepdim=True)
    return (x - mean) / (var + norm.eps).sqrt() * norm.weight + norm.bias


def linear(x: Tensor, layer: nn.Linear) -> Tensor:
    return x @ layer.weight.T + layer.bias


def mlp(x: Tensor, layers) -> Tensor:
    return linear(F.gelu(linear(x, layers.fc1)), layers.fc2)


def attended(q: Tensor, k: Tensor, v: Tensor, q_norm: nn.LayerNorm, k_norm: nn.LayerNorm) -> Tensor:
    """Head by head, of one scene: q (N, D), k and v (M, D)."""
    found = []
    for head in range(HEADS):
        part = slice(head * EACH, (head + 1) * EACH)
        logits = normed(q[:, part], q_norm) @ normed(k[:, part], k_norm).T / EACH**0.5
        found.append(logits.softmax(-1) @ v[:, part])
    return torch.cat(found, -1)


def one_stream(stream: Stream, x: Tensor, memory: Tensor) -> Tensor:
    """Of one scene: (N, D), (M, C)."""
    cross = stream.cross_attention
    k, v = linear(normed(memory, stream.memory_norm), stream.kv_proj).chunk(2, -1)
    q = linear(normed(x, cross.norm), cross.q_proj)
    read = attended(q, k, v, cross.q_norm, stream.k_norm)
    x = x + stream.cross_scale.gamma * linear(read, cross.out_proj)
    x = x + stream.mlp_scale.gamma * mlp(normed(x, stream.norm), stream.mlp)
    for block in stream.blocks:
        core = block.attention
        q, k, v = linear(normed(x, block.norm1), core.qkv).chunk(3, -1)
        read = attended(q, k, v, core.q_norm, core.k_norm)
        x = x + block.scale1.gamma * linear(read, core.proj)
        x = x + block.scale2.gamma * mlp(normed(x, block.norm2), block.mlp)
    return x


def test_a_round_is_two_streams_and_a_mixer() -> None:
    layer = lively(Round(Round.Config(memory_width=10), LayerParts(DIMS, {}, 0.5)))
    memory = ImageMemory(torch.randn(2, 7, 10).double())
    given = QueryState(state().features.double(), {TEXTURE: state()[TEXTURE].double()})
    after, passed = layer(given, memory)
    assert passed is memory
    for scene in range(2):
        tokens = memory.features[scene]
        geometry = one_stream(layer.geometry, given.features[scene], tokens)
        texture = one_stream(layer.texture, given[TEXTURE][scene], tokens)
        both = torch.cat(
            [normed(geometry, layer.geometry_norm), normed(texture, layer.texture_norm)], -1
        )
        update = layer.mixer_scale.gamma * mlp(both, layer.mixer)
        torch.testing.assert_close(after.features[scene], geometry + update[:, :16])
        torch.testing.assert_close(after[TEXTURE][scene], texture + update[:, 16:])


def test_scales_start_as_published() -> None:
    layer = Round(Round.Config(), LayerParts(DIMS, {}, 1e-3))
    scales = {n: p for n, p in layer.named_parameters() if n.endswith("gamma")}
    of_blocks = {n: p for n, p in scales.items() if ".blocks." in n}
    assert len(of_blocks) == 2 * 2 * 2
    assert all((p == 1e-2).all() for p in of_blocks.values())
    assert all((scales[n] == 1e-3).all() for n in scales.keys() - of_blocks.keys())
    assert sorted(scales.keys() - of_blocks.keys()) == [
        *("geometry.cross_scale.gamma", "geometry.mlp_scale.gamma", "mixer_scale.gamma"),
        *("texture.cross_scale.gamma", "texture.mlp_scale.gamma"),
    ]


def test_tokens_that_decode_nothing_are_read() -> None:
    layer = lively(Round(Round.Config(), LayerParts(DIMS, {}, 0.5))).float()
    memory, given = ImageMemory(torch.randn(2, 7, 16)), state()
    mask = torch.tensor([True] * 4 + [False]).expand(2, -1)
    moved = given.features.clone()
    moved[:, 4] += torch.randn(16)
    one, other = (
        layer(QueryState(x, given.fields, mask), memory)[0] for x in (given.features, moved)
    )
    assert not torch.allclose(one.features[:, :4], other.features[:, :4])
    assert one.mask is mask
