"""Measuring: samples in turn, workloads, memory of a process of its own, operations."""

import signal
from copy import deepcopy
from dataclasses import replace
from unittest.mock import Mock, call

import torch
import torch.nn.functional as F
from commands import SMALL
from qgs_research.bench.run import (
    Workload,
    forward_flops,
    in_turn,
    make_task,
    peak_memory,
    posed_photos,
    resident_bytes,
    workload_of,
)
from tables import assert_equal, must_refuse
from torch import nn

from qgs.recipe import resolve

TOKENGS = "tiny/tokengs.yaml"
MODEST = Workload(views=2, targets=2, size=(16, 24))


def test_tasks_take_turns():
    tasks = Mock()
    columns = in_turn([tasks.a, tasks.b, tasks.c], rounds=3, warmup=1)
    assert tasks.mock_calls == [call.a(), call.b(), call.c()] * 4
    assert [*map(len, columns)] == [3, 3, 3]


def test_the_recipe_says_how_much_work_there_is():
    recipe = resolve("locus/dl3dv_4096_4views.yaml")
    assert workload_of(recipe) == Workload(views=4, targets=4, size=(256, 448))
    assert workload_of(recipe, views=6, size=(64, 32)) == Workload(6, 4, (64, 32))
    must_refuse(r"no data\.image_size.*--size HxW", workload_of, resolve("locus/overlay.yaml"))


def test_inference_leaves_the_model_alone_and_a_step_trains_every_part():
    recipe = resolve("tiny/locus.yaml", SMALL)
    model = recipe.build_model()
    before = deepcopy(model.state_dict())
    for operation in ("forward", "render"):
        make_task(operation, recipe, model, MODEST)()
        assert not model.training
        assert_equal(model.state_dict(), before)
        assert all(parameter.grad is None for parameter in model.parameters())
    step = make_task("step", recipe, model, MODEST)
    step()
    step()
    same = [name for name, p in model.named_parameters() if torch.equal(p, before[name])]
    # Softmax ignores what is added to all keys alike; k_norm's bias is that.
    assert not [name for name in same if not name.endswith("k_norm.bias")]


def test_memory_of_a_fresh_process():
    ballast = torch.zeros(2**26)  # 256 MiB that the other process must not count
    recipe = resolve(TOKENGS, ["model.width=512", "model.heads=8"])
    weights = sum(p.numel() for p in recipe.build_model("meta").parameters()) * 4
    peak = peak_memory(recipe, "forward", MODEST, threads=1)
    assert weights < peak.peak_bytes - peak.idle_bytes < 3 * weights
    assert peak.idle_bytes < resident_bytes("VmRSS") - ballast.nbytes / 2


def die(*_):
    signal.raise_signal(9)


def test_what_failed_in_the_process_is_told(monkeypatch):
    recipe = resolve(TOKENGS, SMALL)
    must_refuse(
        "images of 15 x 24 cannot be cut into patches of 8",
        peak_memory,
        recipe,
        "forward",
        Workload(2, 2, (15, 24)),
        threads=1,
    )
    monkeypatch.setattr("qgs_research.bench.run.measure", die)
    must_refuse(
        "was killed", peak_memory, recipe, "forward", MODEST, threads=1, kind=ChildProcessError
    )


def test_operations_are_those_of_layers_and_attention(monkeypatch):
    recipe = resolve(TOKENGS, SMALL)
    model = recipe.build_model().eval()
    turned = 2 * 9 * (2 * 16 * 24)  # the ray of each pixel, by a matrix
    found = [turned]

    def of_layer(layer, inputs, out):
        found.append(2 * out.numel() * layer.weight[0].numel())

    for layer in model.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            layer.register_forward_hook(of_layer)
    attend = F.scaled_dot_product_attention

    def attention(q, k, v, **options):
        found.append(4 * q.numel() * k.shape[-2])
        return attend(q, k, v, **options)

    monkeypatch.setattr(F, "scaled_dot_product_attention", attention)
    model(posed_photos(1, 2, (16, 24), seed=0))
    once = sum(found)
    assert forward_flops(recipe, MODEST) == once
    assert forward_flops(recipe, replace(MODEST, batch=3)) == 3 * once
