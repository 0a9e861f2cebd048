"""Geometry keeps float32 under autocast, float64 stays float64, and devices do not matter."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from qgs.contracts import CrossAttention, SelfAttention
from qgs.testing.case import Case
from qgs.testing.chance import drawn_from
from qgs.testing.faults import CannotCheck, expect
from qgs.testing.learned import HalvedProducts, LearnedLayers, ReplayedLayers
from qgs.testing.modes import each_mode
from qgs.testing.registry import MODULES, PARAMETRIC, check
from qgs.testing.subjects import Inputs, inputs_of
from qgs.testing.trees import (
    cast,
    described,
    distance,
    floating,
    leaves,
    mapped,
    not_finite,
    tracked,
)

EXPLAINED = "explain.geometry"
"""What geometry adds to attention logits; -inf where it keeps a query from looking."""

GEOMETRY = {
    "encoder": ("patch_rays",),
    "queries": ("fields.",),
    "refinement": ("fields.",),
    "head": ("scales", "quats", "opacities"),
    "cross_attention": (EXPLAINED,),
    "self_attention": (EXPLAINED,),
    "centers": ("output",),
    "renderer": ("rgb", "alpha", "depth"),
    "losses": ("",),
}
"""Outputs that are geometry, or measures of it, by the beginning of their names."""

HALVED = (
    "features",
    "state.features",
    "memory.keys",
    "memory.values",
    "memory.features",
    "offsets",
)
"""Inputs that arrive in bfloat16 under autocast."""

RTOL, ATOL = 1e-5, 1e-6
"""How far geometry under autocast may be from float32: bfloat16 rounds by 4e-3."""

CLOSE = 0.1
"""How far bfloat16 may take an output from its float32 value, in units of its spread."""


@check(MODULES)
def check_geometry_is_float32_under_autocast(case: Case) -> None:
    """Under bfloat16 autocast what is computed is finite, and geometry is computed in float32.

    Learned layers run in bfloat16. What is made of their outputs and of the geometry that goes in
    (means, world-frame fields, fields that are read and written again, what a head decodes, what
    geometry adds to attention logits, images, losses) has the values that float32 gives it for the
    same outputs of the layers. In training as in evaluation.
    """
    module = case.lively()
    if case.slot == "queries":
        module.requires_grad_(False)  # its parameters are no layers: they are the geometry
    for mode in each_mode(module):
        _expect_geometry_in_float32(case, module, mode)


def _expect_geometry_in_float32(case: Case, module: Any, mode: str) -> None:
    inputs, where = _halved(inputs_of(case)), f"in {mode} under autocast"
    with (
        drawn_from(0),
        torch.autocast(case.device, dtype=torch.bfloat16),
        LearnedLayers() as layers,
        HalvedProducts() as halved,
    ):
        outputs = _with_explanation(module, inputs)
    broken = [name for name in not_finite(outputs) if name != EXPLAINED]
    expect(not broken, f"{where} {', '.join(broken)} is not finite")
    seen = {n: x for n, x in floating(outputs).items() if n.startswith(GEOMETRY.get(case.slot, ()))}
    for name, tensor in seen.items():
        kept = tensor.dtype == torch.float32
        expect(kept, f"{where} `{name}` is {described(tensor)}, not float32")
    with drawn_from(0), ReplayedLayers(layers.outputs) as replayed:
        exact = floating(_with_explanation(module, cast(inputs, torch.float32)))
    placed = {name: x for name, x in seen.items() if name not in _learned_fields(case)}
    found = distance({name: exact[name] for name in placed}, placed, RTOL, ATOL)
    if found and replayed.differs:
        raise CannotCheck("in float32 it calls other layers than under autocast")
    expect(not found, f"{where}, against float32, {found}")
    if isinstance(module, CrossAttention | SelfAttention):
        told = ", ".join(sorted(halved.names))
        expect(not told, f"{where} the product of float32 geometry by {told} is in bfloat16")


@check(MODULES)
def check_autocast_is_close(case: Case) -> None:
    """Under bfloat16 autocast a component gives what it gives in float32, but for rounding."""
    module, inputs = case.lively(), _halved(inputs_of(case))
    exact = floating(module(*cast(inputs, torch.float32).values()))
    with torch.autocast(case.device, dtype=torch.bfloat16):
        rounded = floating(module(*inputs.values()))
    for name, tensor in exact.items():
        off = (rounded[name].float() - tensor).abs().mean()
        spread = (tensor - tensor.mean()).abs().mean().clamp_min(0.1 * tensor.abs().mean() + 1e-6)
        seen = f"under autocast `{name}` is off by {off / spread:.2g} times its spread"
        expect(bool(off <= CLOSE * spread), seen)


@check(MODULES)
def check_float64_stays_float64(case: Case) -> None:
    """A float64 component with float64 inputs gives float64 outputs, in training too."""
    module = case.lively().double()
    for mode in each_mode(module):
        with drawn_from(0):
            outputs = module(*cast(inputs_of(case), torch.float64).values())
        for name, tensor in floating(outputs).items():
            kept = tensor.dtype == torch.float64
            expect(kept, f"in {mode} `{name}` is {described(tensor)} for float64 inputs")


@check(PARAMETRIC)
def check_moves_to_a_device(case: Case) -> None:
    """Moved to another device (CUDA, else meta), a component computes there, without the CPU."""
    device = "cuda" if torch.cuda.is_available() else "meta"
    module = case.lively().to(device)
    inputs = tracked(mapped(inputs_of(case), lambda _, x: x.to(device)))
    with _autocast_knows_meta():
        outputs = floating(module(*inputs.values()))
    for name, tensor in outputs.items():
        moved = tensor.device.type == device
        expect(moved, f"`{name}` is on {tensor.device}, the component on {device}")
    slopes = [x.sum() for x in outputs.values() if x.requires_grad]
    if slopes:
        torch.autograd.backward(slopes)


@contextmanager
def _autocast_knows_meta() -> Iterator[None]:
    """`torch.autocast(x.device.type, enabled=False)` is sound code, which torch refuses on meta."""
    start = torch.autocast.__init__

    def begin(self: Any, device_type: str, *args: Any, **kwargs: Any) -> None:
        start(self, "cpu" if device_type == "meta" else device_type, *args, **kwargs)

    with patch.object(torch.autocast, "__init__", begin):
        yield


def _halved(inputs: Inputs) -> Inputs:
    """Features in bfloat16, which ask for gradients; geometry asks for none."""

    def visit(name: str, x: Tensor) -> Tensor:
        return x.to(torch.bfloat16).requires_grad_() if name in HALVED else x

    return mapped(inputs, visit)


def _with_explanation(module: Any, inputs: Inputs) -> dict[str, Any]:
    """The outputs, and what geometry adds to the logits of an attention that tells it."""
    outputs = leaves(module(*inputs.values()))
    if isinstance(module, CrossAttention | SelfAttention):
        queries = torch.arange(inputs["state"].features.shape[1])
        explain: Any = module.explain
        weights = explain(*inputs.values(), queries)
        if weights is not None and weights.geometry is not None:
            outputs[EXPLAINED] = weights.geometry
    return outputs


def _learned_fields(case: Case) -> set[str]:
    """Provided fields that stand in no frame and carry on none that was read."""
    required = case.component.requires(case.config)
    provided = case.component.provides(case.config).items()
    return {f"fields.{n}" for n, spec in provided if spec.frame == "none" and n not in required}
