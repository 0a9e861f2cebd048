"""Geometry keeps float32 under autocast, float64 stays float64, and devices do not matter."""

from __future__ import annotations

import torch

from qgs.testing.case import Case
from qgs.testing.faults import expect
from qgs.testing.registry import MODULES, PARAMETRIC, check
from qgs.testing.subjects import Inputs, inputs_of
from qgs.testing.trees import (
    cast,
    described,
    floating,
    mapped,
    not_finite,
    tracked,
)

GEOMETRY = {
    "encoder": ("patch_rays",),
    "queries": ("fields.",),
    "refinement": ("fields.",),
    "head": ("scales", "quats", "opacities"),
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

CLOSE = 0.1
"""How far bfloat16 may take an output from its float32 value, in units of its spread."""


@check(MODULES)
def check_geometry_is_float32_under_autocast(case: Case) -> None:
    """Under bfloat16 autocast what is computed is finite, and geometry stays float32."""
    module, inputs = case.lively(), _halved(inputs_of(case))
    with torch.autocast(case.device, dtype=torch.bfloat16):
        outputs = module(*inputs.values())
    broken = not_finite(outputs)
    expect(not broken, f"under autocast {', '.join(broken)} is not finite")
    for name, tensor in floating(outputs).items():
        if name.startswith(GEOMETRY.get(case.slot, ())):
            kept = tensor.dtype == torch.float32
            expect(kept, f"under autocast `{name}` is {described(tensor)}, not float32")


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
    """A float64 component with float64 inputs gives float64 outputs."""
    module = case.lively().double()
    outputs = module(*cast(inputs_of(case), torch.float64).values())
    for name, tensor in floating(outputs).items():
        kept = tensor.dtype == torch.float64
        expect(kept, f"`{name}` is {described(tensor)} for float64 inputs")


@check(PARAMETRIC)
def check_moves_to_a_device(case: Case) -> None:
    """Moved to another device (CUDA, else meta), a component computes there, without the CPU."""
    device = "cuda" if torch.cuda.is_available() else "meta"
    module = case.lively().to(device)
    inputs = tracked(mapped(inputs_of(case), lambda _, x: x.to(device)))
    outputs = floating(module(*inputs.values()))
    for name, tensor in outputs.items():
        moved = tensor.device.type == device
        expect(moved, f"`{name}` is on {tensor.device}, the component on {device}")
    slopes = [x.sum() for x in outputs.values() if x.requires_grad]
    if slopes:
        torch.autograd.backward(slopes)


def _halved(inputs: Inputs) -> Inputs:
    return mapped(inputs, lambda name, x: x.to(torch.bfloat16) if name in HALVED else x)
