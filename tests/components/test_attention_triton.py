"""The Triton kernels of attention with the biases of LocusGS and of ellipsoids, against float64.

They run on a GPU, or on a CPU under Triton's interpreter, for which TRITON_INTERPRET=1 must be set
before triton is imported: without a GPU, the first test runs this file again in a process with it.
The interpreter computes bfloat16 wrongly (it rounds towards zero and multiplies as integers), so
that type is compiled here, and its results are for a GPU to test.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from qgs_ellipsoid.fields import anchor_rotation
from qgs_ellipsoid.ray_bias import EllipsoidBias
from qgs_ellipsoid.ray_bias import ray_tokens as ellipsoid_tokens
from qgs_locus.ray_bias import RayBias, ray_tokens
from torch import Tensor

from qgs.components import AttentionBias
from qgs.components.attention_bias import biased_attention

HAS_TRITON = find_spec("triton") is not None
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cuda" if torch.cuda.is_available() and not INTERPRETED else "cpu"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not HAS_TRITON, reason='needs triton: pip install "query-gaussians[triton]"'),
]
runs = pytest.mark.skipif(
    DEVICE == "cpu" and not INTERPRETED, reason="runs on a GPU, or with TRITON_INTERPRET=1"
)
compiles = pytest.mark.skipif(INTERPRETED, reason="the interpreter compiles nothing")
kinds = pytest.mark.parametrize("kind", ["locus", "ellipsoid"])

Leaves = dict[str, Tensor]


@pytest.mark.skipif(DEVICE == "cuda" or INTERPRETED, reason="the tests of this file run here")
def test_kernels_pass_under_the_interpreter() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-m", "slow", "-p", "no:cacheprovider"]
    root = Path(__file__).parents[2]
    result = subprocess.run(
        [*command, __file__],
        cwd=root,
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    if result.returncode:
        pytest.fail(result.stdout + result.stderr, pytrace=False)
    assert " passed" in result.stdout


def _case(
    sizes: tuple[int, int, int, int, int], radius: float | None = None, width: float = 1.0
) -> Leaves:
    """B scenes, h heads, N queries, M tokens, d numbers of a head; anchors of `radius`."""
    scenes, heads, queries, tokens, each = sizes
    origins = 0.5 * torch.randn(scenes, tokens, 3)
    directions = F.normalize(torch.randn(scenes, tokens, 3), dim=-1)
    radii = 0.5 + 2 * torch.rand(scenes, queries, 3)
    return {
        "q": width * torch.randn(scenes, queries, heads, each).transpose(1, 2),
        "k": torch.randn(scenes, heads, tokens, each),
        "v": torch.randn(scenes, tokens, heads, 2 * each)[..., ::2].transpose(1, 2),
        "center": torch.randn(scenes, queries, 3),
        "radius": radii if radius is None else torch.full_like(radii, radius),
        "quaternion": torch.randn(scenes, queries, 4),
        "gamma": torch.tensor(0.3),
        "rays": torch.cat([torch.linalg.cross(origins, directions), directions], -1) * 0.97,
        "gradient": torch.randn(scenes, heads, queries, each),
    }


def _bias(kind: str, x: Leaves, lower: float) -> AttentionBias:
    """As the models make it, bandwidths at their floor where 0.1 r is below it."""
    sigma_sq = (0.1 * x["radius"]).square().clamp_min(1e-3)
    if kind == "locus":
        tokens = ray_tokens(x["rays"])
        return RayBias.of(x["center"], sigma_sq[..., :1], tokens, lower, x["gamma"])
    rotation, tokens = anchor_rotation(x["quaternion"]), ellipsoid_tokens(x["rays"])
    return EllipsoidBias.of(x["center"], rotation, sigma_sq, tokens, lower, x["gamma"])


def _direct(q: Tensor, k: Tensor, v: Tensor, bias: AttentionBias) -> Tensor:
    """The formula, with all pairs at once."""
    scenes = zip(bias.queries, bias.tokens, strict=True)
    mask_BNM = torch.stack([bias.value(*read) for read in scenes])
    return (q @ k.mT * q.shape[-1] ** -0.5 + mask_BNM[:, None]).softmax(-1) @ v


def _in_triton(q: Tensor, k: Tensor, v: Tensor, bias: AttentionBias) -> Tensor:
    return biased_attention(q, k, v, bias, "triton")


def _found(
    attention: Callable[..., Tensor], kind: str, case: Leaves, lower: float
) -> tuple[Leaves, Tensor]:
    """The result, the gradients of all that learns, and the bias of all pairs."""
    unused = {"rays", "gradient"} | ({"quaternion"} if kind == "locus" else set())
    x = {name: leaf.detach().clone() for name, leaf in case.items()}
    learnt = {name: leaf.requires_grad_() for name, leaf in x.items() if name not in unused}
    bias = _bias(kind, x, lower)
    read = attention(x["q"], x["k"], x["v"], bias)
    gradients = torch.autograd.grad(read, list(learnt.values()), x["gradient"])
    names = {"read": read.detach(), **dict(zip(learnt, gradients, strict=True))}
    return names, torch.stack([bias.value(*r) for r in zip(bias.queries, bias.tokens, strict=True)])


def _assert_exact(kind: str, case: Leaves, lower: float = -20.0, tolerance: float = 1e-5) -> Tensor:
    """The share of pairs at the bound. Errors are relative to what is of order 1 or more: the one
    number of gamma is a sum of numbers of both signs. Where all is 0 but for rounding, to ones."""
    exact, bias = _found(_direct, kind, {n: x.double() for n, x in case.items()}, lower)
    seen, _ = _found(_in_triton, kind, {n: x.to(DEVICE) for n, x in case.items()}, lower)
    for name, x in seen.items():
        size = float(exact[name].norm())
        size = max(size, 1.0) if size > 1e-10 else x.numel() ** 0.5
        error = (x.cpu() - exact[name]).norm() / size
        assert error < tolerance, (name, float(error))
    return (bias <= bias.min() * (1 - 1e-6)).double().mean()


SIZES = {
    "odd": (2, 3, 67, 131, 24),
    "one query": (2, 2, 1, 70, 32),
    "one token": (2, 2, 70, 1, 32),
    "one of each": (1, 1, 1, 1, 8),
    "many scenes": (5, 1, 9, 33, 16),
    "wide heads": (1, 2, 40, 70, 80),
    "narrow heads": (1, 2, 33, 40, 3),
}


@runs
@kinds
@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
def test_gradients_are_those_of_float64(sizes: tuple[int, ...], kind: str) -> None:
    _assert_exact(kind, _case(sizes))


@runs
@kinds
def test_all_pairs_at_the_bound(kind: str) -> None:
    case = _case((2, 2, 40, 70, 16))
    assert _assert_exact(kind, case, lower=-1e-9) == 1.0


@runs
@kinds
def test_no_pair_at_the_bound(kind: str) -> None:
    case = _case((2, 2, 40, 70, 16), radius=20.0)
    assert _assert_exact(kind, case, lower=-1e9) < 0.001


@runs
@kinds
def test_radius_at_its_floor(kind: str) -> None:
    _assert_exact(kind, _case((2, 2, 40, 70, 16), radius=0.1))


@runs
@kinds
@pytest.mark.parametrize("first", range(0, 200, 50))
def test_drawn_cases(first: int, kind: str) -> None:
    for number in range(first, first + 50):
        torch.manual_seed(number)
        sizes = tuple(int(torch.randint(1, most, ())) for most in (3, 3, 70, 100, 40))
        _assert_exact(kind, _case(sizes), lower=-20 * float(torch.rand(())))
