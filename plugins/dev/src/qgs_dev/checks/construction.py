"""Construction: what `Component`, its `Config` and `nn.Module` give a class that does as usual."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy
import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from qgs.containers import map_tensors
from qgs.contracts import ComponentConfig
from qgs.recipe.build import OnMeta
from qgs.recipe.decode import configs_in, decode_config
from qgs.recipe.errors import Problems, RecipeError
from qgs.recipe.yaml_text import dump, load_mapping
from qgs_dev.case import Case
from qgs_dev.inputs import inputs_of
from qgs_dev.modules import seeded, tensors_of
from qgs_dev.vocabulary import expect, expect_none, expect_same, floating, tracked


def check_construction(case: Case) -> None:
    """Options are those that were written, and modules are drawn, saved, loaded and moved whole.

    Options written as YAML and read again are the same, also after building; a misspelt one is
    refused with the nearest one. A component with parameters allocates nothing under the meta
    device, keeps every tensor as a parameter or a buffer, draws from torch's global generator
    alone, gives the same bits from saved weights, and computes on the device that it is moved to.
    """
    _expect_strict_options(case)
    if case.slot != "data":
        # A shallow copy would share lists, and their change would go unseen.
        own = case.with_config(case.config.model_copy(deep=True))
        own.build()
        same = own.config == case.config
        expect(same, f"when it is built, {case.config!r} becomes {own.config!r}")
    if case.has_parameters:
        with torch.device("meta"), OnMeta():
            tensors = tensors_of(case.construct())
        real = [name for name, tensor in tensors.items() if not tensor.is_meta]
        expect_none(real, "allocated; leave the device to the caller")
        _expect_drawn_from_torch(case)
        _expect_registered(case.build())
        _expect_loadable(case)
        _expect_movable(case)


def _expect_strict_options(case: Case) -> None:
    options = case.config.model_dump(mode="json")
    names = list(type(case.config).model_fields)
    expect_none(set(names) - options.keys(), "not written")
    again, message = _decoded(case, options)
    expect(again is not None, f"{options} is refused: {message}")
    expect(again == case.config, f"{case.config!r} is read again as {again!r}")
    # One letter too many: near enough for a suggestion.
    wrong = f"{names[0]}_x" if names else "no_such_option"
    config, message = _decoded(case, {**options, wrong: 1})
    expect(config is None, f"the option `{wrong}` is accepted")
    expect(not names or f"did you mean `{names[0]}`" in message, f"the message is: {message}")
    for model in configs_in(type(case.config)):
        strict = model.model_config.get("extra") == "forbid"
        expect(strict, f"{model.__qualname__} accepts any option; derive it from ComponentConfig")


def _decoded(case: Case, options: dict[str, Any]) -> tuple[ComponentConfig | None, str]:
    """The options that the composer reads from YAML, and the message if it refuses them."""
    problems = Problems()
    node = load_mapping(dump(options), "case", problems)
    config = decode_config(case.component.Config, node, (), problems)
    try:
        problems.raise_any()
    except RecipeError as error:
        return config, str(error)
    return config, ""


def _expect_drawn_from_torch(case: Case) -> None:
    # Training resumes torch's generator alone.
    others = other_generators()
    after = []
    for seed in (1, 2):
        with seeded(seed):
            case.construct()
            after.append(torch.get_rng_state())
    expect(not torch.equal(*after), "after being built from two seeds, torch is in one state")
    expect(others == other_generators(), "building draws from numpy's or random's generator")
    first, second = (dict(case.build(seed=3).state_dict()) for _ in range(2))
    expect_same(first, second, "two instances built from one seed differ")


def other_generators() -> tuple[Any, str]:
    """The states of the random generators that components must not use."""
    return random.getstate(), str(numpy.random.get_state())


def _expect_registered(module: nn.Module) -> None:
    for name, part in module.named_modules():
        # Torch's own layers may list their parameters a second time, as its recurrent ones do.
        of_torch = type(part).__module__.startswith("torch.")
        for key, value in vars(part).items():
            listed = value if isinstance(value, list | tuple) and not of_torch else ()
            kept = [value] if isinstance(value, Tensor) else listed
            outside = any(isinstance(x, Tensor | nn.Module) for x in kept)
            where = f"{name or 'the component'} keeps {key}"
            expect(not outside, f"{where} outside of its parameters, buffers and modules")


def _expect_loadable(case: Case) -> None:
    module = case.lively(seed=1)
    weights = {name: x.contiguous() for name, x in module.state_dict().items()}
    other = case.build(seed=2).eval()
    other.load_state_dict(load(save(weights)))
    inputs = inputs_of(case).values()
    expect_same(module(*inputs), other(*inputs), "with the same state dict")


def _expect_movable(case: Case) -> None:
    device = "cuda" if torch.cuda.is_available() else "meta"
    inputs = tracked(map_tensors(lambda x: x.to(device), inputs_of(case)))
    with _autocast_accepts_meta():
        outputs = floating(case.lively().to(device)(*inputs.values()))
    for name, tensor in outputs.items():
        moved = tensor.device.type == device
        expect(moved, f"`{name}` is on {tensor.device}, the component on {device}")
    # The backward pass has devices of its own.
    totals = [x.sum() for x in outputs.values() if x.requires_grad]
    if totals:
        torch.autograd.backward(totals)


@contextmanager
def _autocast_accepts_meta() -> Iterator[None]:
    """`torch.autocast(x.device.type, enabled=False)` is valid code, which torch refuses on meta."""
    start = torch.autocast.__init__

    def begin(self: Any, device_type: str, *args: Any, **kwargs: Any) -> None:
        start(self, "cpu" if device_type == "meta" else device_type, *args, **kwargs)

    with patch.object(torch.autocast, "__init__", begin):
        yield
