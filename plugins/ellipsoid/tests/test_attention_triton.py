"""The Triton kernels of attention with the biases of LocusGS and of ellipsoids, against float64.

They run on a GPU, or on a CPU under Triton's interpreter, for which TRITON_INTERPRET=1 must be set
before triton is imported: without a GPU, the first test runs this file again in a process with it.
The interpreter computes bfloat16 wrongly, so that half precision is compiled here, and its results
are for a GPU to test. (triton 3.9.0's interpreter was tried; that of 3.5 cannot run loops beside
NumPy 2.4, though these kernels compile with it.)
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
from qgs_locus.kernels.attention_bias import AttentionBias, biased_attention
from qgs_locus.ray_bias import RayBias, ray_tokens
from torch import Tensor

HAS_TRITON = find_spec("triton") is not None
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cuda" if torch.cuda.is_available() and not INTERPRETED else "cpu"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not HAS_TRITON, reason='needs triton: pip install "query-gaussians-locus[triton]"'
    ),
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
    root = Path(__file__).parents[3]
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
    """The result, the gradients of all that learns, and the bias of all pairs.

    That of gamma is replaced by the shares in it of each query's two numbers that are multiples of
    gamma: plain torch adds them up to one number, in which they all but cancel.
    """
    unused = {"rays", "gradient"} | ({"quaternion"} if kind == "locus" else set())
    x = {name: leaf.detach().clone() for name, leaf in case.items()}
    learnt = {name: leaf.requires_grad_() for name, leaf in x.items() if name not in unused}
    bias = _bias(kind, x, lower)
    learnt["queries"] = bias.queries
    read = attention(x["q"], x["k"], x["v"], bias)
    gradients = torch.autograd.grad(read, list(learnt.values()), x["gradient"])
    found = {"read": read.detach(), **dict(zip(learnt, gradients, strict=True))}
    shares = found["queries"][..., -2:] * bias.queries.detach()[..., -2:]
    torch.testing.assert_close(found["gamma"] * x["gamma"], shares.sum(), rtol=1e-3, atol=1e-3)
    found["gamma"] = shares
    return found, torch.stack([bias.value(*r) for r in zip(bias.queries, bias.tokens, strict=True)])


def _assert_exact(kind: str, case: Leaves, lower: float = -20.0, tolerance: float = 1e-5) -> Tensor:
    """The share of pairs at the bound. Errors are relative to what is of order 1 or more: where
    most pairs reach the bound, gradients are sums of numbers of order 1 that nearly cancel. What is
    0 but for rounding is compared with ones."""
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
def test_pairs_at_the_bound_and_radii_at_their_floor(kind: str) -> None:
    sizes = 2, 2, 40, 70, 16
    assert _assert_exact(kind, _case(sizes), lower=-1e-9) == 1.0
    assert _assert_exact(kind, _case(sizes, radius=20.0), lower=-1e9) < 0.001
    _assert_exact(kind, _case(sizes, radius=0.1))


@runs
@kinds
@pytest.mark.parametrize("first", range(0, 200, 50))
def test_drawn_cases(first: int, kind: str) -> None:
    for number in range(first, first + 50):
        torch.manual_seed(number)
        sizes = tuple(int(torch.randint(1, most, ())) for most in (3, 3, 70, 100, 40))
        _assert_exact(kind, _case(sizes), lower=-20 * float(torch.rand(())))


@runs
def test_the_same_bits_each_time() -> None:
    case = {name: x.to(DEVICE) for name, x in _case((2, 2, 70, 70, 16)).items()}
    once, again = (_found(_in_triton, "ellipsoid", case, -20.0)[0] for _ in range(2))
    assert all(torch.equal(once[name], again[name]) for name in once)


@runs
@kinds
@pytest.mark.parametrize("learnt", ["q", "k", "v", "center", "kv", "q center"])
def test_what_is_frozen_gets_no_gradient_and_the_others_get_the_same(
    learnt: str, kind: str
) -> None:
    case = {name: x.to(DEVICE) for name, x in _case((1, 2, 40, 70, 16)).items()}
    names = ("q", "k", "v", "center")

    def gradients(chosen: str) -> Leaves:
        x = {n: leaf.detach().clone().requires_grad_(n in chosen) for n, leaf in case.items()}
        _in_triton(x["q"], x["k"], x["v"], _bias(kind, x, -20.0)).backward(case["gradient"])
        return {n: x[n].grad for n in names if x[n].grad is not None}

    expected, found = gradients(" ".join(names)), gradients(learnt)
    assert set(found) == {name for name in names if name in learnt}
    for name, gradient in found.items():  # on a GPU other products and sums are fused
        torch.testing.assert_close(gradient, expected[name], rtol=1e-5, atol=1e-6)


@runs
@kinds
@pytest.mark.skipif(DEVICE == "cpu", reason="the interpreter computes bfloat16 wrongly")
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision(dtype: torch.dtype, kind: str) -> None:
    def halved(q: Tensor, k: Tensor, v: Tensor, bias: AttentionBias) -> Tensor:
        return _in_triton(q.to(dtype), k.to(dtype), v.to(dtype), bias).float()

    case = _case((2, 3, 130, 200, 64))
    exact, _ = _found(_direct, kind, {name: x.double() for name, x in case.items()}, -20.0)
    seen, _ = _found(halved, kind, {name: x.to(DEVICE) for name, x in case.items()}, -20.0)
    for name, x in seen.items():
        assert (x.cpu() - exact[name]).norm() < 2e-2 * exact[name].norm(), name


SHARED = {80: 166_912, 89: 101_376, 90: 232_448}
"""Bytes of shared memory that a block of threads may take, by compute capability."""


@compiles
@kinds
@pytest.mark.parametrize(
    ("arch", "dtype", "sizes", "learnt"),
    [
        (80, torch.bfloat16, (2, 4, 1000, 2000, 64), "q k v center"),
        (89, torch.float16, (2, 4, 1000, 2000, 128), "q k v center"),
        (89, torch.bfloat16, (1, 1, 100, 100, 256), "q k v center"),
        (89, torch.float32, (2, 4, 1000, 2000, 128), "q k v center"),
        (90, torch.bfloat16, (2, 4, 1000, 2000, 64), "q k v center"),
        (90, torch.float32, (1, 1, 1, 1, 24), "q k v center"),
        (90, torch.bfloat16, (2, 4, 1000, 2000, 64), "v center"),
        (90, torch.bfloat16, (2, 4, 1000, 2000, 64), "q"),
        (90, torch.bfloat16, (2, 4, 1000, 2000, 64), "k"),
    ],
    ids=str,
)
def test_kernels_compile_for_gpus_that_are_not_here(
    kind: str,
    arch: int,
    dtype: torch.dtype,
    sizes: tuple[int, ...],
    learnt: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    jit = import_module("triton.runtime.jit").JITFunction
    driver = import_module("triton.runtime.driver").driver
    target = import_module("triton.backends.compiler").GPUTarget("cuda", arch, 32)
    attention = import_module("qgs_locus.kernels.attention_triton").TritonAttention
    compiled, run = [], jit.run

    def compile_alone(self: Any, *args: Any, grid: Any, warmup: bool, **kwargs: Any) -> None:
        compiled.append(run(self, *args, grid=grid, warmup=True, **kwargs))

    monkeypatch.setattr(jit, "run", compile_alone)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    gpu = SimpleNamespace(
        get_current_target=lambda: target,
        get_current_device=lambda: arch,
        get_current_stream=lambda device: 0,
    )
    monkeypatch.setattr(driver, "_active", gpu)
    case = _case(sizes)
    bias = _bias(kind, {n: x.requires_grad_(n in learnt.split()) for n, x in case.items()}, -20.0)
    q, k, v = (case[name].to(dtype) for name in "qkv")
    read = attention.apply(q, k, v, bias.queries, bias.tokens, bias.triton_functions())
    read.sum().backward()
    needed = {"_backward_queries": {"q", "center"}, "_backward_tokens": {"k", "v"}}
    passes = [name for name, inputs in needed.items() if inputs & {*learnt.split()}]
    assert [kernel.metadata.name for kernel in compiled] == ["_forward", *passes]
    for kernel in compiled:
        assert kernel.metadata.shared <= SHARED[arch]
        assert "tt.dot" in kernel.asm["ttir"]
        assert "atomic" not in kernel.asm["ttir"], "sums must be deterministic"
