"""Geometry keeps float32 under autocast, learned layers stay close, float64 stays float64."""

from collections.abc import Iterable
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from qgs.containers import map_tensors, named_tensors
from qgs.contracts import CrossAttention, SelfAttention
from qgs.geometry.precision import at_least_float32
from qgs_dev.case import CannotCheck, Case, expect
from qgs_dev.inputs import Inputs, inputs_of
from qgs_dev.modules import each_mode, seeded
from qgs_dev.registry import MODULES, check
from qgs_dev.trees import cast, described, difference, floating, leaves, mapped, not_finite

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
    "renderer": ("rgb", "alpha", "depth", "features"),
    "losses": ("",),
}
"""Outputs that are geometry, or measures of it, by the beginning of their names."""

HALVED = {
    *("features", "state.features", "offsets"),
    *("memory.keys", "memory.values", "memory.features"),
}
"""Inputs that arrive in bfloat16 under autocast."""

RTOL, ATOL = 1e-5, 1e-6
"""How far geometry under autocast may be from float32: bfloat16 rounds by 4e-3."""

LAYERS = {
    *("linear", "bilinear", "conv1d", "conv2d", "conv3d", "layer_norm", "rms_norm", "group_norm"),
    *("gru", "lstm", "gru_cell", "lstm_cell", "rnn_tanh_cell", "rnn_relu_cell"),
    *("multi_head_attention_forward", "scaled_dot_product_attention"),
}
"""Functions of torch that are layers of a network, if anything in them is learned."""

PRODUCTS = {
    *("matmul", "__matmul__", "__rmatmul__"),
    *("mm", "mv", "bmm", "addmm", "baddbmm", "einsum"),
}
"""Functions of torch that are layers or geometry, such as a rotation of points."""


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
        where = f"in {mode} under autocast"
        inputs = _halved(inputs_of(case))
        autocast = torch.autocast(case.device, dtype=torch.bfloat16)
        with seeded(0), autocast, LearnedLayers() as layers:
            outputs = _with_explanation(module, inputs)
        broken = [name for name in not_finite(outputs) if name != EXPLAINED]
        expect(not broken, f"{where} {', '.join(broken)} is not finite")
        seen = {
            n: x for n, x in floating(outputs).items() if n.startswith(GEOMETRY.get(case.slot, ()))
        }
        for name, tensor in seen.items():
            kept = tensor.dtype == torch.float32
            expect(kept, f"{where} `{name}` is {described(tensor)}, not float32")
        with seeded(0), LearnedLayers(layers.outputs) as replayed:
            exact = floating(_with_explanation(module, cast(inputs, torch.float32)))
        required = case.component.fields_read(case.config)
        provided = case.component.fields_written(case.config).items()
        # Fields that stand in no frame and carry on none that was read.
        learned = {f"fields.{n}" for n, s in provided if s.frame == "none" and n not in required}
        placed = {name: x for name, x in seen.items() if name not in learned}
        found = difference({name: exact[name] for name in placed}, placed, RTOL, ATOL)
        if found and replayed.differs:
            raise CannotCheck("in float32 it calls other layers than under autocast")
        expect(not found, f"{where}, against float32, {found}")
        if isinstance(module, CrossAttention | SelfAttention):
            names = ", ".join(sorted(layers.halved))
            expect(not names, f"{where} the product of float32 geometry by {names} is in bfloat16")


def _halved(inputs: Inputs) -> Inputs:
    """Features in bfloat16, which require gradients; geometry requires none."""
    return mapped(inputs, lambda name, x: x.bfloat16().requires_grad_() if name in HALVED else x)


def _with_explanation(module: Any, inputs: Inputs) -> dict[str, Any]:
    """The outputs, and what geometry adds to the logits of an attention that explains itself."""
    outputs = leaves(module(*inputs.values()))
    if isinstance(module, CrossAttention | SelfAttention):
        explain: Any = module.explain
        weights = explain(*inputs.values(), torch.arange(inputs["state"].features.shape[1]))
        if weights is not None and weights.geometry is not None:
            outputs[EXPLAINED] = weights.geometry
    return outputs


@check(MODULES)
def check_autocast_is_close(case: Case) -> None:
    """Under bfloat16 autocast a component gives what it gives in float32, but for rounding.

    That is to within a tenth of the spread of each output.
    """
    module, inputs = case.lively(), _halved(inputs_of(case))
    exact = floating(module(*cast(inputs, torch.float32).values()))
    with torch.autocast(case.device, dtype=torch.bfloat16):
        rounded = floating(module(*inputs.values()))
    for name, tensor in exact.items():
        off = (rounded[name].float() - tensor).abs().mean()
        spread = (tensor - tensor.mean()).abs().mean().clamp_min(0.1 * tensor.abs().mean() + 1e-6)
        seen = f"under autocast `{name}` is off by {off / spread:.2g} times its spread"
        expect(bool(off <= 0.1 * spread), seen)


@check(MODULES)
def check_float64_stays_float64(case: Case) -> None:
    """A float64 component with float64 inputs gives float64 outputs, in training too."""
    module = case.lively().double()
    for mode in each_mode(module):
        with seeded(0):
            outputs = module(*cast(inputs_of(case), torch.float64).values())
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
        if not ((name in LAYERS and any(learned)) or (name in PRODUCTS and all(learned))):
            halved = name in PRODUCTS and given.dtype == torch.bfloat16 and not any(learned)
            if halved and all(x.dtype == torch.float32 for x in factors):
                self.halved.add(name)
            return given
        if self._replayed is None:
            self.outputs.append((name, map_tensors(torch.clone, given)))
        elif not self.differs:
            recorded, before = next(self._replayed, ("", None))
            self.differs = recorded != name or _shapes(before) != _shapes(given)
            return given if self.differs else map_tensors(at_least_float32, before)
        return given


def _shapes(value: Any) -> list[torch.Size]:
    return [tensor.shape for _, tensor in named_tensors(value)]
