"""Merging, blends, rotations and activations, one Gaussian after the other, in Python's floats."""

import math

import pytest
import torch
from qgs_zoo.globalsplat.head import MergingHead, rotation_6d
from qgs_zoo.globalsplat.streams import TEXTURE
from small_parts import made
from tables import assert_equal
from torch.nn.functional import layer_norm
from torch.testing import assert_close

from qgs.geometry.transforms import quat_to_matrix
from qgs.types import QueryState

DRAW = torch.Generator().manual_seed(0)
GEOMETRY = 2 * torch.randn(1, 3, 16, 14, generator=DRAW).double()
GEOMETRY[..., 0, 3:5] = torch.tensor([-9, 9])  # scales beyond both bounds
TEXTURES = torch.randn(1, 3, 16, 48, generator=DRAW).double()
STATE = QueryState(torch.randn(2, 5, 16), {TEXTURE: torch.randn(2, 5, 16)})


def orthonormal(six):
    """Gram and Schmidt: the columns of a rotation."""
    q, r = torch.linalg.qr(six.double().view(2, 3).T)
    a, b = (q * r.diagonal().sign()).T
    return torch.stack([a, b, torch.linalg.cross(a, b)], 1)


def one_gaussian(block, colours):
    """Of raw candidates (S, 14) and coefficients (S, 48), by the formulas of the paper."""
    gates = block[:, 13].softmax(0)
    log_scale = (block[:, 3:6] - 2).clip(math.log(1e-4) - 1, math.log(0.05) + 2)
    opacity = (block[:, 12] - 5).sigmoid()
    sh = (gates @ colours).view(16, 3)
    return (
        gates @ block[:, :3],
        (gates @ log_scale).exp() * len(block) ** (1 / 3),
        orthonormal(gates @ (block[:, 6:12] + torch.tensor([1, 0, 0, 0, 1, 0]))),
        1 - ((1 - opacity) ** gates).prod(),
        0.5 + 0.5 / math.sqrt(math.pi) * sh[0],
        sh[1:],
    )


def test_blocks_are_merged_by_the_formulas():
    for level in range(5):
        out = made(MergingHead, level=level).activate(GEOMETRY, TEXTURES)
        places = (out.offsets, out.scales, quat_to_matrix(out.quats))
        for token in range(3):
            blocks = (x[0, token].chunk(2**level) for x in (GEOMETRY, TEXTURES))
            for place, block in enumerate(zip(*blocks, strict=True)):
                found = (x[0, token, place] for x in (*places, out.opacities, out.colors, out.sh))
                assert_close((*found,), one_gaussian(*block), rtol=1e-7, atol=1e-12)


def test_a_blend_shows_both_levels():
    levels = (1, 1.25, 2)
    coarse, blend, fine = (made(MergingHead, level=x).activate(GEOMETRY, TEXTURES) for x in levels)
    assert_close(blend.offsets, torch.cat([coarse.offsets, fine.offsets], 2))
    clear = torch.cat([(1 - coarse.opacities) ** 0.75, (1 - fine.opacities) ** 0.25], 2)
    assert_close(1 - blend.opacities, clear)


def test_quaternions_of_all_rotations():
    """Of the 24 that map axes to axes, and of others."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    turns = [torch.cat([a, b]) for a in axes for b in axes if a @ b == 0]
    turns = torch.stack([*turns, *torch.randn(31, 6)]).double()
    quats = rotation_6d(turns)
    assert_close(quats.norm(dim=-1), torch.ones(55).double())
    assert_equal(quat_to_matrix(quats), torch.stack([*map(orthonormal, turns)]), atol=1e-12)


def test_what_tells_no_rotation_still_gives_a_unit_quaternion():
    same = [1.0, 2, 3] * 2
    second = [0.0, 0, 0, 1, 0, 0]
    vectors = torch.tensor([[0.0] * 6, same, second, [1e-9] * 6], requires_grad=True)
    quats = rotation_6d(vectors)
    assert_close(quats.norm(dim=-1), torch.ones(4))
    quats.sum().backward()
    assert vectors.grad.isfinite().all()


def test_the_head_reads_both_streams_after_their_norms():
    head = made(MergingHead, candidates=4, level=2)
    geometry = head.geometry(layer_norm(STATE.features, (16,))).unflatten(-1, (4, 14))
    texture = head.texture(layer_norm(STATE[TEXTURE], (16,))).unflatten(-1, (4, 48))
    out = head(STATE)
    wanted = head.activate(geometry, texture)
    assert_equal((out.sh, out.scales), (wanted.sh, wanted.scales))


def test_weights_start_as_told():
    head = made(MergingHead, candidates=64, level=6, init_std=0.1, position_std=0.5)
    rows = head.geometry.weight.unflatten(0, (64, 14))
    for weights, std in ((rows[:, :3], 0.5), (rows[:, 3:], 0.1), (head.texture.weight, 0.1)):
        assert weights.std().item() == pytest.approx(std * 0.99, rel=0.05)
    assert not head.geometry.bias.any() | head.texture.bias.any()
