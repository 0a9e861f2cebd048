"""Geometry keeps float32 under autocast, learned layers stay close, float64 stays float64."""

from collections.abc import Iterable
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from qgs.containers import map_tensors, named_tensors
from qgs.geometry.precision import at_least_float32
from qgs_dev.case import CannotCheck, Case
from qgs_dev.checks.attention import explanation
from qgs_dev.inputs import FACTS, Inputs, data_file
from qgs_dev.modules import each_mode, seeded
from qgs_dev.vocabulary import (
    Trial,
    cast,
    described,
    difference,
    expect,
    expect_finite,
    expect_none,
    floating,
    leaves,
    mapped,
)

ATTENTION = ("cross_attention", "self_attention")

# What geometry adds to attention logits; -inf where it keeps a query from looking.
EXPLAINED = "explain.geometry"

# How far geometry under autocast may be from float32: bfloat16 rounds by 4e-3.
RTOL = 1e-5
ATOL = 1e-6

# Inputs that are halved under autocast, and functions of torch that are layers or products.
NAMES: dict[str, list[str]] = data_file("precision.toml")


def check_geometry_is_float32_under_autocast(case: Case) -> None:
    """Under bfloat16 autocast what is computed is finite, and geometry is computed in float32.

    Learned layers run in bfloat16. What is made of their outputs and of the geometry that goes in
    (means, world-frame fields, fields that are read and written again, what a head decodes, what
    geometry adds to attention logits, images, losses) has the values that float32 gives it for the
    same outputs of the layers. In training as in evaluation.
    """
    trial = Trial(case)
    module = trial.module
    inputs = _halved(trial.inputs)
    if case.slot == "queries":
        # Its parameters are no layers: they are the geometry.
        module.requires_grad_(False)
    for mode in each_mode(module):
        where = f"in {mode} under autocast"
        with seeded(0), _autocast(case), LearnedLayers() as layers:
            outputs = _with_explanation(trial, inputs)
        expect_finite({n: x for n, x in outputs.items() if n != EXPLAINED}, where)
        # Replayed, learned layers give the same in both, and what differs is geometry alone.
        with seeded(0), LearnedLayers(layers.outputs) as replayed:
            exact = _with_explanation(trial, cast(inputs, torch.float32))
        geometry = tuple(FACTS[case.slot].get("geometry", ()))
        seen = {name: x for name, x in floating(outputs).items() if name.startswith(geometry)}
        for name, tensor in seen.items():
            kept = tensor.dtype == torch.float32
            expect(kept, f"{where} `{name}` is {described(tensor)}, not float32")
        # Fields that stand in no frame and carry on none that was read are learned.
        for name, spec in case.writes.items():
            if spec.frame == "none" and name not in case.reads:
                seen.pop(f"fields.{name}", None)
        found = difference({name: exact[name] for name in seen}, seen, RTOL, ATOL)
        if found and replayed.differs:
            raise CannotCheck("in float32 it calls other layers than under autocast")
        expect(not found, f"{where}, against float32, {found}")
        if case.slot in ATTENTION:
            expect_none(layers.halved, f"takes float32 geometry to bfloat16 {where}")


def _autocast(case: Case) -> torch.autocast:
    return torch.autocast(case.device, dtype=torch.bfloat16)


def _halved(inputs: Inputs) -> Inputs:
    """Features in bfloat16, which require gradients; geometry requires none."""
    return mapped(
        inputs, lambda name, x: x.bfloat16().requires_grad_() if name in NAMES["halved"] else x
    )


def _with_explanation(trial: Trial, inputs: Inputs) -> dict[str, Any]:
    """The outputs, and what geometry adds to the logits of an attention that explains itself."""
    outputs = leaves(trial(inputs))
    if trial.case.slot in ATTENTION:
        weights = explanation(trial.module, inputs)
        if weights is not None and weights.geometry is not None:
            outputs[EXPLAINED] = weights.geometry
    return outputs


def check_autocast_is_close(case: Case) -> None:
    """Under bfloat16 autocast a component gives what it gives in float32, but for rounding.

    That is to within a tenth of the spread of each output.
    """
    trial = Trial(case)
    inputs = _halved(trial.inputs)
    exact = floating(trial(cast(inputs, torch.float32)))
    with _autocast(case):
        rounded = floating(trial(inputs))
    for name, tensor in exact.items():
        off = (rounded[name].float() - tensor).abs().mean()
        # A constant output has no spread: then its size counts.
        spread = (tensor - tensor.mean()).abs().mean().clamp_min(0.1 * tensor.abs().mean() + 1e-6)
        seen = f"under autocast `{name}` is off by {off / spread:.2g} times its spread"
        expect(off <= 0.1 * spread, seen)


def check_float64_stays_float64(case: Case) -> None:
    """A float64 component with float64 inputs gives float64 outputs, in training too."""
    trial = Trial(case)
    trial.module.double()
    for mode, outputs in trial.in_each_mode(cast(trial.inputs, torch.float64)):
        for name, tensor in floating(outputs).items():
            kept = tensor.dtype == torch.float64
            expect(kept, f"in {mode} `{name}` is {described(tensor)} for float64 inputs")


class LearnedLayers(TorchFunctionMode):
    """Keeps what learned layers give, in their order, in `outputs`; or gives `replayed` instead.

    A product counts as a learned layer if all its factors require gradients: parameters, features,
    and what is made of them. halved: names of the products of float32 tensors, none of them
    learned, that autocast took to bfloat16. differs: whether other layers were called than those
    that gave `replayed`; from the first such one on, layers give what they compute.
    """

    def __init__(self, replayed: Iterable[tuple[str, Any]] | None = None) -> None:
        super().__init__()
        self.outputs: list[tuple[str, Any]] = []
        self.halved: set[str] = set()
        self.differs = False
        self._replayed = None if replayed is None else iter(replayed)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func`; keep what it gives if it is a learned layer, or give what is replayed."""
        given = func(*args, **(kwargs or {}))
        name = getattr(func, "__name__", "")
        factors = [x for _, x in named_tensors([args, kwargs or {}])]
        learned = [x.requires_grad for x in factors]
        product = name in NAMES["products"]
        if (product and all(learned)) or (name in NAMES["layers"] and any(learned)):
            return self._of_layer(name, given)
        exact = all(x.dtype == torch.float32 for x in factors)
        if product and exact and not any(learned) and given.dtype == torch.bfloat16:
            self.halved.add(name)
        return given

    def _of_layer(self, name: str, given: Any) -> Any:
        if self._replayed is None:
            self.outputs.append((name, map_tensors(torch.clone, given)))
        elif not self.differs:
            # Replayed layers must come in the order in which they were recorded.
            recorded, before = next(self._replayed, ("", None))
            self.differs = recorded != name or _shapes(before) != _shapes(given)
            return given if self.differs else map_tensors(at_least_float32, before)
        return given


def _shapes(value: Any) -> list[torch.Size]:
    return [tensor.shape for _, tensor in named_tensors(value)]
