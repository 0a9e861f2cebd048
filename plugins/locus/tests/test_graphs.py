"""Operators of a forward pass by part, and its graph: each operator is a launch on a GPU."""

from functools import partial

import pytest
import torch
from attending import case
from commands import SMALL
from model_parts import parts_of
from odd_views import odd_views
from qgs_locus.kernels import attention_bias
from qgs_locus.kernels.attention_bias import attention_mask
from qgs_locus.ray_bias import RayBias
from tables import rows
from torch.testing import assert_close

import qgs

VIEWS = odd_views(width=24)
MOST = """
tokengs | total | 161
tokengs | decoder.self_attention | 24
tokengs | decoder.cross_attention | 20
locus | total | 352
locus | decoder.self_attention | 88
locus | decoder.cross_attention | 81
locus | refinements | 44
landmark | total | 783
landmark | decoder.self_attention | 138
landmark | queries | 310
"""
"""Operators of four layers with plain attention. They may only fall."""


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(attention_bias, "chosen_kernel", lambda *_: "plain")
    return lambda name: qgs.compose(f"tiny/{name}.yaml", SMALL).eval()


@torch.inference_mode()
def test_operators_of_a_forward_pass_may_only_fall(small, monkeypatch):
    # on a GPU, the mask is one kernel
    monkeypatch.setattr(attention_bias, "attention_mask", lambda *_: torch.zeros(1, 1, 1))
    for name, part, most in rows(MOST):
        model = small(name)
        operators, _ = parts_of(model, partial(model, VIEWS))
        operators["total"] = operators.total()
        assert operators[part] <= int(most), (name, part)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["locus", "landmark"])
@torch.inference_mode()
@torch.autocast("cpu", torch.bfloat16)
def test_a_model_is_one_graph_with_equal_results(small, name):
    model = small(name)
    expected = model(VIEWS).gaussians
    model.compile(backend="aot_eager", fullgraph=True)
    found = model(VIEWS).gaussians
    assert_close(vars(found), vars(expected))


def test_the_mask_is_one_graph_with_gradients():
    compiled = torch.compile(attention_mask, backend="aot_eager", fullgraph=True)
    given = case((2, 1, 9, 33, 8))
    queries = given["queries"].requires_grad_()
    read = RayBias.value, queries, given["tokens"], torch.bfloat16
    masks = [mask(*read) for mask in (attention_mask, compiled)]
    gradients = [torch.autograd.grad(mask.float().square().sum(), queries) for mask in masks]
    assert masks[0].dtype == torch.bfloat16
    assert_close(*masks)
    assert_close(*gradients)
