"""Which parameters decay."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn

from qgs.composer import Recipe
from qgs.contracts import TrainingConfig
from qgs.engine.optimizer import make_optimizer, parameter_groups


def undecayed_names(module: nn.Module) -> set[str]:
    _, undecayed = parameter_groups(module)
    chosen = {id(p) for p in undecayed}
    return {name for name, p in module.named_parameters() if id(p) in chosen}


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_the_head_and_1d_parameters_do_not_decay(tiny: Callable[..., Recipe], name: str) -> None:
    model = tiny(name).build_model("meta")
    expected = {n for n, p in model.named_parameters() if p.ndim == 1 or n.startswith("head.")}
    assert undecayed_names(model) == expected
    assert undecayed_names(nn.ModuleDict({"model": model})) == {f"model.{n}" for n in expected}


def test_queries_anchors_and_gammas_decay(tiny: Callable[..., Recipe]) -> None:
    model = tiny("locus").build_model("meta")
    decayed = set(dict(model.named_parameters())) - undecayed_names(model)
    gammas = {f"decoder.{i}.cross_attention.raw_gamma" for i in range(model.depth)}
    assert {"queries.features", "queries.center", "queries.raw_radius"} | gammas <= decayed


def test_every_trained_parameter_is_in_one_group(tiny: Callable[..., Recipe]) -> None:
    model = tiny("locus").build_model()
    model.queries.features.requires_grad_(False)
    optimizer = make_optimizer(model, TrainingConfig(weight_decay=0.1))
    trained = [id(p) for p in model.parameters() if p.requires_grad]
    grouped = [id(p) for group in optimizer.param_groups for p in group["params"]]
    assert sorted(grouped) == sorted(trained)
    assert [group["weight_decay"] for group in optimizer.param_groups] == [0.1, 0.0]
    assert optimizer.defaults["betas"] == (0.9, 0.95)


def test_decay_shrinks_only_what_decays(tiny: Callable[..., Recipe]) -> None:
    model = tiny("tokengs").build_model()
    config = TrainingConfig(weight_decay=0.5, learning_rate=0.1)
    optimizer = make_optimizer(model, config)
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    kept = undecayed_names(model)
    for name, parameter in model.named_parameters():
        factor = 1.0 if name in kept else 1 - 0.1 * 0.5
        torch.testing.assert_close(parameter.detach(), before[name] * factor)
