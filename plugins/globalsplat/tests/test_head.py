"""Merging, blends, rotations and activations, one Gaussian after the other, in Python's floats."""

import math

import numpy as np
import pytest
import torch
from globalsplat_inputs import DIMS, state
from qgs_globalsplat.head import MergingHead, merged, rotation_6d
from qgs_globalsplat.streams import TEXTURE
from torch import Tensor

from qgs.contracts import ModelDims, RecipeContext
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import GaussianAttributes, Gaussians

LOW, HIGH = math.log(1e-4) - 1, math.log(0.05) + 2


def raw(candidates: int = 16, seed: int = 0) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    geometry = 2 * torch.randn(1, 3, candidates, 14, generator=draw, dtype=torch.float64)
    return geometry, torch.randn(1, 3, candidates, 48, generator=draw, dtype=torch.float64)


def head(**options) -> MergingHead:
    return MergingHead(MergingHead.Config(**options), DIMS)


def orthonormal(six: np.ndarray) -> np.ndarray:
    """Gram and Schmidt: the columns of a rotation."""
    a, b = six[:3], six[3:]
    a = a / np.linalg.norm(a)
    b = b - (a @ b) * a
    b = b / np.linalg.norm(b)
    return np.stack([a, b, np.cross(a, b)], 1)


def one_gaussian(block: np.ndarray, colours: np.ndarray) -> dict[str, np.ndarray]:
    """Of raw candidates (S, 14) and coefficients (S, 48), by the formulas of the paper."""
    gates = np.exp(block[:, 13]) / np.exp(block[:, 13]).sum()
    log_scale = np.clip(block[:, 3:6] - 2, LOW, HIGH)
    opacity = 1 / (1 + np.exp(5 - block[:, 12]))
    sh = (gates @ colours).reshape(16, 3)
    return {
        "offset": gates @ block[:, :3],
        "scale": np.exp(gates @ log_scale) * len(block) ** (1 / 3),
        "rotation": orthonormal(gates @ (block[:, 6:12] + np.array([1, 0, 0, 0, 1, 0]))),
        "opacity": 1 - np.prod((1 - opacity) ** gates),
        "color": 0.5 + 0.5 / math.sqrt(math.pi) * sh[0],
        "sh": sh[1:],
    }


@pytest.mark.parametrize("level", [0, 1, 2, 3, 4])
def test_blocks_are_merged_by_the_formulas(level: int) -> None:
    geometry, texture = raw()
    out = head(level=level).activate(geometry, texture)
    size = 16 // 2**level
    for token in range(3):
        for place in range(2**level):
            block = slice(place * size, (place + 1) * size)
            x = (part[0, token, block].numpy() for part in (geometry, texture))
            wanted = one_gaussian(*x)
            at = 0, token, place
            np.testing.assert_allclose(out.offsets[at], wanted["offset"])
            np.testing.assert_allclose(out.scales[at], wanted["scale"])
            matrix = quat_to_matrix(out.quats[at])
            np.testing.assert_allclose(matrix, wanted["rotation"], atol=1e-12)
            np.testing.assert_allclose(out.opacities[at], wanted["opacity"])
            np.testing.assert_allclose(out.colors[at], wanted["color"])
            np.testing.assert_allclose(out.sh[at], wanted["sh"])


def test_sixteen_gaussians_are_the_candidates_whatever_the_gates() -> None:
    geometry, texture = raw()
    one = head(level=4).activate(geometry, texture)
    geometry[..., 13] = 7 * torch.randn(1, 3, 16)
    other = head(level=4).activate(geometry, texture)
    torch.testing.assert_close(one.offsets, geometry[..., :3])
    torch.testing.assert_close(one.opacities, torch.sigmoid(geometry[..., 12] - 5))
    assert torch.equal(one.scales, other.scales)


def test_equal_candidates_merge_to_themselves_larger_by_their_number() -> None:
    geometry, texture = (x[:, :, :1].expand(-1, -1, 16, -1).clone() for x in raw())
    geometry[..., 13] = torch.randn(1, 3, 16)
    each = head(level=4).activate(geometry, texture)
    both = head(level=1).activate(geometry, texture)
    torch.testing.assert_close(both.scales, 2 * each.scales[:, :, :2])  # 8 of them: twice as wide
    for name in ("offsets", "quats", "opacities", "colors", "sh"):
        torch.testing.assert_close(getattr(both, name), getattr(each, name)[:, :, :2])


def test_a_gate_chooses() -> None:
    candidates = torch.randn(2, 8, 5)
    gates = torch.zeros(2, 8)
    gates[:, 5] = 60.0
    torch.testing.assert_close(merged(candidates, gates, 2)[:, 1], candidates[:, 5])
    torch.testing.assert_close(merged(candidates, gates, 2)[:, 0], candidates[:, :4].mean(1))


def test_a_blend_shows_both_levels_and_ends_in_either() -> None:
    geometry, texture = raw()

    def at(level: float) -> GaussianAttributes:
        made = head(level=level)
        out = made.activate(geometry, texture)
        assert out.offsets.shape[2] == made.gaussians_per_query
        return out

    coarse, blend, fine = at(1), at(1.25), at(2)
    assert blend.offsets.shape[2] == 2 + 4
    torch.testing.assert_close(blend.offsets, torch.cat([coarse.offsets, fine.offsets], 2))
    clear = torch.cat([(1 - coarse.opacities) ** 0.75, (1 - fine.opacities) ** 0.25], 2)
    torch.testing.assert_close(1 - blend.opacities, clear)
    assert at(1 + 1e-9).opacities[:, :, 2:].max() < 1e-8
    assert at(2 - 1e-9).opacities[:, :, :2].max() < 1e-8


def test_the_published_level_grows_with_the_steps() -> None:
    made = head(level=0.0)
    for level, count in ((0.0, 1), (0.5, 3), (1.0, 2), (2.875, 12), (3.0, 8)):
        made.config = made.config.model_copy(update={"level": level})
        assert made.gaussians_per_query == count
        assert made(state()).offsets.shape == (2, 5, count, 3)


@pytest.mark.parametrize("turn", range(40))
def test_quaternions_of_all_rotations(turn: int) -> None:
    rng = np.random.default_rng(turn)
    six = rng.normal(size=6) if turn > 8 else np.eye(3)[rng.permutation(3)[:2]].ravel()
    six = six * rng.choice([-1, 1], size=6)
    quat = rotation_6d(torch.tensor(six))
    np.testing.assert_allclose(quat.norm(), 1)
    np.testing.assert_allclose(quat_to_matrix(quat), orthonormal(six), atol=1e-12)


@pytest.mark.parametrize("six", [[0.0] * 6, [1, 2, 3, 1, 2, 3], [0, 0, 0, 1, 0, 0], [1e-9] * 6])
def test_what_tells_no_rotation_still_gives_a_unit_quaternion(six: list[float]) -> None:
    vectors = torch.tensor(six, dtype=torch.float32, requires_grad=True)
    quat = rotation_6d(vectors)
    assert quat.norm().item() == pytest.approx(1)
    (slope,) = torch.autograd.grad(quat.sum(), vectors)
    assert slope.isfinite().all()


def test_the_head_reads_both_streams_after_their_norms() -> None:
    torch.manual_seed(0)
    made, given = head(candidates=4, level=2), state()
    normed = torch.nn.functional.layer_norm
    geometry = made.geometry(normed(given.features, (16,))).unflatten(-1, (4, 14))
    texture = made.texture(normed(given[TEXTURE], (16,))).unflatten(-1, (4, 48))
    assert torch.equal(made(given).sh, made.activate(geometry, texture).sh)
    assert torch.equal(made(given).scales, made.activate(geometry, texture).scales)


def test_weights_start_as_told() -> None:
    options = {"candidates": 64, "level": 6, "init_std": 0.1, "position_std": 0.5}
    made = MergingHead(MergingHead.Config(**options), ModelDims(64, 2, 1))
    rows = made.geometry.weight.unflatten(0, (64, 14))
    assert rows[:, :3].std().item() == pytest.approx(0.5 * 0.99, rel=0.05)
    assert rows[:, 3:].std().item() == pytest.approx(0.1 * 0.99, rel=0.05)
    assert made.texture.weight.std().item() == pytest.approx(0.1 * 0.99, rel=0.05)
    assert not made.geometry.bias.any() | made.texture.bias.any()


@pytest.mark.parametrize(("degree", "count"), [(1, 3), (2, 8), (3, 15)])
def test_degrees(degree: int, count: int) -> None:
    out = head(sh_degree=degree)(state())
    assert out.sh.shape == (2, 5, 8, count, 3)
    Gaussians(*(x.flatten(1, 2) for x in (out.offsets, out.scales, out.quats)), *(
        x.flatten(1, 2) for x in (out.opacities, out.colors, out.sh)
    ))  # fmt: skip


def test_options_that_do_not_fit_are_refused() -> None:
    def told(**options) -> str:
        config = MergingHead.Config(**options)
        return " ".join(p.reason for p in MergingHead.problems(config, RecipeContext(DIMS)))

    assert told(candidates=4, level=2.5) == "2^2.5 Gaussians cannot be merged of 4"
    assert told(scale_min=0.1) == "it is not below `scale_max`, 0.05"
    assert not told(candidates=4, level=2)
    assert "power of two" in told(candidates=12)
