"""The Triton kernels of attention with a bias against float64; on a GPU the other ways too.

They run on a GPU, or on a CPU under Triton's interpreter, for which TRITON_INTERPRET=1 must be set
before triton is imported: without a GPU, the first test runs this file again in a process with it.
The interpreter computes bfloat16 wrongly, so that half precision is compiled here, and its results
are for a GPU to test. (triton 3.9.0's interpreter was tried; that of 3.5 cannot run loops beside
NumPy 2.4, though these kernels compile with it.)
"""

import os
import subprocess
import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from random import Random
from types import SimpleNamespace

import pytest
import torch
from attending import case, exact, found, wrong
from qgs_locus.kernels.attention_bias import biased_attention
from qgs_locus.ray_bias import RayBias
from size import ROOT
from tables import assert_equal
from torch.testing import assert_close

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cuda" if torch.cuda.is_available() and not INTERPRETED else "cpu"

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not find_spec("triton"), reason="needs triton")]
runs = pytest.mark.skipif(
    DEVICE == "cpu" and not INTERPRETED, reason="runs on a GPU, or with TRITON_INTERPRET=1"
)
compiles = pytest.mark.skipif(INTERPRETED, reason="the interpreter compiles nothing")
kernels = pytest.mark.parametrize(
    "kernel", ["triton", "plain", "blocks"] if DEVICE == "cuda" else ["triton"]
)

LEARNT = ("q", "k", "v", "queries")
TRITON = partial(biased_attention, kernel="triton")


def _on_device(given):
    return {name: x.to(DEVICE) for name, x in given.items()}


@pytest.mark.skipif(DEVICE == "cuda" or INTERPRETED, reason="the tests of this file run here")
def test_kernels_pass_under_the_interpreter():
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-m", "slow", "-p", "no:cacheprovider", __file__],
        cwd=ROOT,
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    if result.returncode:
        pytest.fail(result.stdout + result.stderr, pytrace=False)
    assert " passed" in result.stdout


@runs
@kernels
def test_gradients_are_those_of_float64(kernel):
    """Bounds of 0 and -1e9 hold for all pairs and for none; a factor of 100 is a thin anchor."""
    for number in range(24):
        torch.manual_seed(number)
        pick = Random(number).choice
        sizes = pick((1, 2)), pick((1, 3)), pick((1, 9, 67)), pick((1, 33, 131))
        sizes = *sizes, pick((3, 8, 24, 80))
        given = case(sizes, *pick(((1, -6), (1, -0.5), (1, 0), (0.01, -1e9), (100, -6))))
        seen = found(partial(biased_attention, kernel=kernel), RayBias, _on_device(given), LEARNT)
        assert seen.keys() == {"read", *LEARNT}
        assert not wrong(seen, exact(RayBias, given, LEARNT)), (number, sizes)


@runs
def test_bits_are_the_same_each_time_and_what_is_frozen_gets_no_gradient():
    given = _on_device(case((1, 2, 70, 70, 16)))
    whole, again = (found(TRITON, RayBias, given, LEARNT) for _ in range(2))
    assert_equal(again, whole)
    for learnt in (*zip(LEARNT, strict=True), ("k", "v"), ("q", "queries")):
        expected = {name: whole[name] for name in ("read", *learnt)}
        # on a GPU other products and sums are fused
        assert_close(found(TRITON, RayBias, given, learnt), expected, rtol=1e-5, atol=1e-6)


@runs
def test_operators_keep_the_rules_of_torch_and_stay_in_graphs():
    given = _on_device(case((1, 2, 20, 33, 16)))
    compiled = torch.compile(TRITON, backend="aot_eager", fullgraph=True)
    seen, expected = (found(x, RayBias, given, LEARNT) for x in (compiled, TRITON))
    assert_close(seen, expected)
    read = [given[name].requires_grad_() for name in LEARNT]
    kernels = import_module("qgs_locus.kernels.attention_triton")
    torch.library.opcheck(kernels.attention, [*read, given["tokens"]])


@runs
@kernels
@pytest.mark.skipif(DEVICE == "cpu", reason="the interpreter computes bfloat16 wrongly")
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision(dtype, kernel):
    given = case((2, 3, 130, 200, 64))
    halved = {name: x.to(dtype) if len(name) == 1 else x for name, x in _on_device(given).items()}
    seen = found(lambda *read: biased_attention(*read, kernel).float(), RayBias, halved, LEARNT)
    assert not wrong(seen, exact(RayBias, given, LEARNT), 2e-2)


SHARED = {80: 166_912, 89: 101_376, 90: 232_448}
"""Bytes of shared memory that a block of threads may take, by compute capability."""
USUAL = (2, 4, 1000, 2000, 64)


@compiles
@pytest.mark.parametrize(
    ("arch", "dtype", "sizes", "learnt"),
    [
        (80, torch.bfloat16, USUAL, LEARNT),
        (89, torch.float32, (2, 4, 1000, 2000, 128), LEARNT),
        (89, torch.bfloat16, (1, 1, 100, 100, 256), LEARNT),
        (90, torch.float16, (1, 1, 1, 1, 24), ("v", "queries")),
        (90, torch.bfloat16, USUAL, LEARNT),
        (90, torch.bfloat16, USUAL, ("q",)),
        (90, torch.bfloat16, USUAL, ("k",)),
    ],
    ids=str,
)
def test_kernels_compile_for_gpus_that_are_not_here(
    arch, dtype, sizes, learnt, monkeypatch, tmp_path
):
    jit = import_module("triton.runtime.jit").JITFunction
    driver = import_module("triton.runtime.driver").driver
    target = import_module("triton.backends.compiler").GPUTarget("cuda", arch, 32)
    attention = import_module("qgs_locus.kernels.attention_triton").attention
    compiled = []
    run = jit.run

    def compile_alone(self, *args, warmup, **kwargs):
        compiled.append(run(self, *args, warmup=True, **kwargs))

    monkeypatch.setattr(jit, "run", compile_alone)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    gpu = SimpleNamespace(
        get_current_target=lambda: target,
        get_current_device=lambda: arch,
        get_current_stream=lambda device: 0,
    )
    monkeypatch.setattr(driver, "_active", gpu)

    def halved(q, k, v, bias):
        halves = (x.to(dtype) for x in (q, k, v))
        return attention(*halves, bias.queries, bias.tokens)[0].float()

    found(halved, RayBias, case(sizes), learnt)
    needed = {"_backward_queries": {"q", "queries"}, "_backward_tokens": {"k", "v"}}
    passes = [name for name, inputs in needed.items() if inputs & {*learnt}]
    assert [kernel.metadata.name for kernel in compiled] == ["_forward", *passes]
    for kernel in compiled:
        assert kernel.metadata.shared <= SHARED[arch]
        assert "tt.dot" in kernel.asm["ttir"]
        assert "atomic" not in kernel.asm["ttir"], "sums must be deterministic"
