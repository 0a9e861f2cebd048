"""Which kernel computes attention with a bias that is a function, with made-up memory."""

from types import SimpleNamespace

import pytest
import torch
from qgs_locus.kernels import attention_choice
from qgs_locus.kernels.attention_bias import biased_attention
from qgs_locus.kernels.attention_choice import SHARE, chosen_kernel
from qgs_locus.ray_bias import RayBias
from tables import must_refuse


class NotInTriton(RayBias):
    in_triton = False


def case(bias_type=RayBias, dtype=torch.float32, width=8):
    """q and a bias that learns."""
    center = torch.randn(2, 5, 3, requires_grad=True)
    bias = bias_type.of(center, 1.0, torch.randn(2, 6, 7), -20.0, torch.ones(()))
    return torch.randn(2, 3, 5, width, dtype=dtype), bias


@pytest.fixture
def chosen(monkeypatch):
    """What a GPU chooses of which a layer may take `memory` bytes, with or without Triton."""

    def of(kernel="auto", memory=0, triton=True, gpu=7, learnt=False, **options):
        found = SimpleNamespace(total_memory=memory * SHARE, major=gpu)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: found)
        monkeypatch.setattr(attention_choice, "TRITON", triton)
        q, bias = case(**options)
        bias.tokens.requires_grad_(learnt)
        # a tensor, as far as the choice looks, that says it is on CUDA
        known = {name: getattr(q, name) for name in ("shape", "dtype", "element_size")}
        on_cuda = SimpleNamespace(**known, device=SimpleNamespace(type="cuda"))
        return chosen_kernel(on_cuda, bias, kernel)

    return of


PAIRS = 2 * 5 * 7


def test_the_plain_path_is_taken_while_it_fits(chosen):
    for dtype, trains, each in (
        (torch.float32, True, 4 + 3 * 4),
        (torch.bfloat16, True, 2 + 3 * 2),
        (torch.float32, False, 4),
    ):
        with torch.set_grad_enabled(trains):
            assert chosen(memory=PAIRS * each, dtype=dtype) == "plain"
            assert chosen(memory=PAIRS * each - 1, dtype=dtype) == "triton"


def test_what_triton_cannot_compute_goes_through_blocks(chosen):
    for options in (
        {"triton": False},
        {"bias_type": NotInTriton},
        {"width": 300},
        {"dtype": torch.float64},
        {"learnt": True},
    ):
        assert chosen(**options) == "blocks"
        must_refuse("triton", chosen, "triton", **options)
    assert chosen(gpu=6, memory=PAIRS * 99) == "blocks"


@torch.no_grad()
def test_tokens_that_could_learn_go_through_triton_where_nothing_does(chosen):
    assert chosen(learnt=True) == "triton"


def test_on_a_cpu_blocks_are_taken_and_triton_is_refused(monkeypatch):
    monkeypatch.setattr(attention_choice, "INTERPRETED", False)
    q, bias = case()
    assert chosen_kernel(q, bias, "auto") == "blocks"
    must_refuse("a GPU", biased_attention, q, q, q, bias, "triton")
