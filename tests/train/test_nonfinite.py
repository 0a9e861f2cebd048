"""Steps that are not finite: which tensor was first."""

from functools import partial
from itertools import count
from types import SimpleNamespace

import pytest
import torch
from training_runs import batches, stream_of, tiny

from qgs.train.distributed import make_accelerator
from qgs.train.guard import first_bad_tensor, not_finite
from qgs.train.training_pass import TrainingPass, compute_gradients

NAN = float("nan")
INF = float("inf")


@pytest.fixture
def step():
    """One step of a small model, of two batches, that can be broken in many places."""
    recipe = tiny("tokengs", "training.render_views=1")
    drawn = batches(stream_of(recipe), 2, 2)
    objective = TrainingPass(recipe, recipe.build_model().train())
    accelerator = make_accelerator("cpu", unread=False)
    gradients = partial(compute_gradients, accelerator, objective, recipe.training, drawn)
    first = partial(first_bad_tensor, objective, drawn, gradients)
    return SimpleNamespace(objective=objective, batches=drawn, gradients=gradients, first=first)


def told(step, tensor, batch):
    """Whether the words about a step begin with the tensor, and name the samples of the batch."""
    drawn = step.batches[batch]
    words = step.first()
    parts = (f"scene {drawn.scenes[0]!r}", f"targets {list(drawn.windows[0][1])}")
    return words.startswith(f"the first bad tensor is {tensor}") and all(p in words for p in parts)


def test_a_good_step_shows_nothing_and_keeps_no_hook(step):
    def hooks():
        modules = step.objective.modules()
        return [dict(kept) for m in modules for kept in (m._forward_hooks, m._forward_pre_hooks)]

    step.gradients()  # after which the checks of a first forward pass are gone
    before = hooks()
    assert step.first() == ""
    assert hooks() == before
    assert not any(p._backward_hooks for p in step.objective.parameters())


def test_a_weight_comes_before_everything_and_data_is_named_with_its_batch(step):
    _, second = step.batches
    for name, tensor in (
        ("targets.cameras.c2w", second.targets.cameras.c2w),
        ("inputs.images", second.inputs.images),
    ):
        tensor.view(-1)[0] = NAN
        assert told(step, f"{name} (1 of {tensor.numel()} values, the first nan)", 1)
    name, parameter = list(step.objective.model.named_parameters())[5]
    parameter.data.view(-1)[:2] = torch.tensor([NAN, INF])
    values = f"2 of {parameter.numel()} values, the first nan"
    assert told(step, f"weight model.{name} ({values})", 0)


def spoiled(module, call, spoil):
    """A hook by which one call of a module, from 1, returns what `spoil` makes of its result."""
    calls = count(1)
    return module.register_forward_hook(
        lambda module, given, result: spoil(result) if next(calls) == call else None
    )


def poisoned(x):
    """`x`, with gradients that are not finite."""
    x.register_hook(lambda slope: slope * NAN)
    return x


def test_a_module_is_named_by_its_output_and_the_gradient_of_it(step):
    """The head runs twice in a batch, after each of two layers."""
    model = step.objective.model
    layer = model.decoder[1]
    across = "output of model.decoder.1.cross_attention"
    blank = lambda r: r.replace(depth=r.depth * NAN)  # noqa: E731
    bent = lambda r: r.replace(rgb=poisoned(1 * r.rgb))  # noqa: E731
    scaled = lambda a: a.replace(scales=a.scales * INF)  # noqa: E731
    for module, call, spoil, tensor, batch in (
        (layer.cross_attention, 1, poisoned, f"gradient of the {across}", 0),
        (layer.self_attention, 2, lambda x: x * INF, "output of model.decoder.1.self_attention", 1),
        (model.renderer, 1, bent, "gradient of the output of model.renderer.rgb", 0),
        (model.renderer, 1, blank, "output of model.renderer.depth", 0),
        (model.head, 3, scaled, "output of model.head.scales", 1),
    ):
        with spoiled(module, call, spoil):
            assert told(step, tensor, batch)


def test_what_is_not_finite_is_named():
    assert not not_finite({"mse": 1.0, "gradient": 0.5, "psnr": INF})
    assert not_finite({"mse": NAN, "gradient": 0.5}) == "mse is nan"
    assert not_finite({"mse": 1.0, "gradient": INF}) == "gradient is inf"
