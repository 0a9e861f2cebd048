"""Attention with a bias that is a function: against plain attention, in every number of blocks."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from attending import case, exact, flex, found, wrong
from qgs_locus.kernels import attention_bias
from qgs_locus.kernels.attention_bias import BLOCK, AttentionBias, biased_attention
from qgs_locus.ray_bias import RayBias
from torch.testing import assert_close

PLAIN = partial(biased_attention, kernel="plain")


class InTorch(RayBias):
    """Without kernels, which give no gradients of tokens."""

    kernels = ""


LEARNT = ("q", "k", "v", "queries", "tokens")
SIZES = (2, 3, 20, 30, 8)
PATHS = ((biased_attention, InTorch), (biased_attention, RayBias), (PLAIN, InTorch))
KINDS = ((RayBias, LEARNT[:4]), (InTorch, LEARNT))


def faults(given):
    """What is wrong with kernels, and without."""
    best = exact(RayBias, given, LEARNT)
    all_ = [wrong(found(biased_attention, kind, given, learnt), best) for kind, learnt in KINDS]
    return [errors for errors in all_ if errors]


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch):
    monkeypatch.setitem(BLOCK, "cpu", 4 * 60 * 7)
    monkeypatch.setattr(attention_bias, "_PART", 100)


def test_gradients_are_those_of_float64(monkeypatch):
    for number in range(42):
        monkeypatch.setitem(BLOCK, "cpu", 4 * (1 + number % 7) * 60)
        torch.manual_seed(number)
        sizes = [int(torch.randint(1, most, ())) for most in (3, 4, 30, 60, 33)]
        lower = (-4 * torch.rand(()), 0.0, -1e9)[number % 3]  # reached by some pairs, all, none
        assert not faults(case(sizes, lower=lower)), number


@pytest.mark.filterwarnings("ignore:flex_attention called without torch.compile")
def test_flex_attention_gives_the_same():
    given = case(SIZES)
    read = given["q"], given["k"], given["v"], RayBias(given["queries"], given["tokens"])
    assert_close(flex(*read), biased_attention(*read))


def test_what_other_devices_compute_is_the_same(monkeypatch):
    assert attention_bias._flash_for_cpu() is not None
    monkeypatch.setattr(attention_bias, "_flash_for_cpu", lambda: None)
    assert not faults(case(SIZES))


def test_bfloat16_comes_back_in_bfloat16_and_the_bias_stays_in_float32():
    given = case(SIZES)
    best = exact(RayBias, given, LEARNT)
    for name in ("q", "k", "v", "gradient"):
        given[name] = given[name].bfloat16()
    for attention in (biased_attention, PLAIN):
        with torch.autocast("cpu", torch.bfloat16):
            seen = found(attention, RayBias, given, LEARNT)
        assert seen["read"].dtype == seen["q"].dtype == torch.bfloat16
        assert seen["queries"].dtype == torch.float32
        assert not wrong(seen, best, 2e-2)


def test_a_pass_without_gradients_comes_before_one_with_them(monkeypatch):
    monkeypatch.setattr(attention_bias, "_kept", SimpleNamespace())  # no memory yet
    given = case(SIZES)
    with torch.inference_mode():
        bias = InTorch(given["queries"], given["tokens"])
        read = biased_attention(given["q"], given["k"], given["v"], bias)
    assert torch.equal(found(biased_attention, InTorch, given, LEARNT)["read"], read)


def test_what_is_frozen_gets_no_gradient_and_the_others_get_the_same(monkeypatch):
    given = case(SIZES)
    best = exact(RayBias, given, LEARNT)
    made = []
    of_bias = AttentionBias.gradients

    def kept(*read):
        made.append(of_bias(*read))
        return made[-1]

    monkeypatch.setattr(AttentionBias, "gradients", kept)
    for learnt in (*zip(LEARNT, strict=True), ("queries", "tokens"), LEARNT):
        wanted = {("queries" in learnt, "tokens" in learnt)} - {(False, False)}
        for attention, kind in PATHS:
            made.clear()
            seen = found(attention, kind, given, learnt)
            assert seen.keys() == {"read", *learnt}
            if attention is biased_attention:
                assert {tuple(x is not None for x in pair) for pair in made} == wanted
            assert not wrong(seen, best)
