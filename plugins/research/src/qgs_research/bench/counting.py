"""Operations and memory of a pass, counted from shapes alone: nothing is computed or allocated.

The pass runs on tensors without numbers (torch's FakeTensorMode) while a dispatch mode counts every
storage and every operator. Compiled kernels are not called; of them the renderer is counted.
"""

import gc
import math
import weakref
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from threading import Thread
from typing import Any, Literal, NamedTuple, TypeAlias
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_pre_hook
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from qgs.machine import in_threads
from qgs.recipe import Recipe
from qgs_research.bench.work import Operation, Workload, make_task

Kind: TypeAlias = Literal["matmul", "attention", "pointwise", "view"]
ATEN = torch.ops.aten
_SCALARS = ATEN._local_scalar_dense.default, ATEN.item.default
_MAKES_MOMENTS = ATEN.zeros, ATEN.zeros_like, ATEN.scalar_tensor
_MATMULS = {ATEN.mm: 0, ATEN.bmm: 0, ATEN.addmm: 1, ATEN.addmm_: 1, ATEN.baddbmm: 1}
"""Operators, and which argument is the left matrix."""


class Work(NamedTuple):
    """An operator. shape: of a matmul (batch, m, k, n), of attention (batch times heads, queries,
    tokens, width of a head), of a pointwise one the bytes read and written, of a view nothing.
    flags: of a matmul whether each matrix is transposed; of attention whether it goes backward."""

    kind: Kind
    dtype: torch.dtype
    shape: tuple[int, ...] = ()
    flags: tuple[bool, ...] = ()


@dataclass
class Count:
    """peak, weights: bytes. work: how often. splats: Gaussians times views rendered.
    compiled: whether kernels that are compiled at the first call were called."""

    parameters: int = 0
    weights: int = 0
    peak: int = 0
    splats: int = 0
    compiled: bool = False
    work: Counter[Work] = field(default_factory=Counter)

    @property
    def computed(self) -> int:
        """Operators that compute something."""
        return sum(times for work, times in self.work.items() if work.shape)


def count(recipe: Recipe, operation: Operation, workload: Workload) -> Count:
    """What `operation` takes when it is not the first. ValueError where shapes do not suffice."""
    found: list[Count | Exception] = []

    def run() -> None:
        try:
            found.append(_count(recipe, operation, workload))
        except Exception as error:
            found.append(error)

    thread = Thread(target=run)  # components keep buffers by thread: no fake one may stay in ours
    gc.freeze()  # a pass makes many objects: each collection would search all of torch again
    thread.start()
    thread.join()
    gc.unfreeze()
    if isinstance(found[0], Count):
        return found[0]
    reason = str(found[0]).partition("\n")[0]
    raise ValueError(
        f"the {operation} cannot be predicted from shapes ({type(found[0]).__name__}: {reason}); "
        "measure it: leave out --predict"
    ) from found[0]


def _count(recipe: Recipe, operation: Operation, workload: Workload) -> Count:
    model: Any = recipe.build_model("meta")
    counting = _Counting()
    with _without_numbers(counting), counting:
        model = model.to_empty(device="cpu")
        model._warned = True  # of cameras, whose numbers are not known
        weights = counting.now
        task = make_task(operation, recipe, model, workload)
        counting.found = found = Count(sum(p.numel() for p in model.parameters()), weights)
        found.peak = counting.now

        def render(_: nn.Module, inputs: Sequence[Any]) -> None:
            found.splats += math.prod(inputs[1].c2w.shape[:2]) * inputs[0].count

        model.renderer.register_forward_pre_hook(render)
        hook = register_optimizer_step_pre_hook(lambda *_: counting.begin_moments())
        task()
        hook.remove()
        if counting.moments:  # this first step has made them, later ones begin with them
            now, peak = counting.moments
            found.peak = max(found.peak, peak + counting.now - now)
        return found


class _Counting(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.found, self.now = Count(), 0
        self.moments: tuple[int, int] | None = None
        self._known: dict[int, Any] = {}

    def begin_moments(self) -> None:
        """The optimiser makes its moments from here on."""
        self.moments = self.now, self.found.peak

    def _see(self, tensor: Tensor) -> bool:
        """Count the storage of `tensor` for as long as it lives; False for one already counted."""
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key in self._known:
            return False

        def freed(_: object) -> None:
            if self._known.pop(key, None) is not None:
                self.now -= size

        self._known[key] = weakref.ref(storage, freed)
        self.now += size
        self.found.peak = max(self.found.peak, self.now)
        return True

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> object:
        if func is torch.ops.prim.device.default:  # fake tensors ask at each operator
            return torch.device("cpu")
        if func in _SCALARS:  # a number that is asked for is one, or true
            return 1.0 if args[0].is_floating_point() else args[0].dtype == torch.bool or 1
        out = func(*args, **(kwargs or {}))
        if self.moments and func.overloadpacket in _MAKES_MOMENTS:
            self._see(out)  # memory, but no work of later steps
            return out
        made = [leaf for leaf in tree_leaves(out) if isinstance(leaf, Tensor)]
        new = [self._see(tensor) for tensor in made]
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        # In place: no new storage, and the schema marks an argument as written.
        self.found.work[_work(func, args, given, made, any(new) or func._schema.is_mutable)] += 1
        return out


def _work(func: Any, args: Any, given: list[Tensor], made: list[Tensor], computes: bool) -> Work:
    packet, dtype = func.overloadpacket, given[0].dtype if given else torch.float32
    if packet is ATEN.linear:  # of inference mode; its weight is (out, in)
        left, right = args[0], args[1].mT
        return Work(
            "matmul",
            dtype,
            (1, *(left.numel() // left.shape[-1], left.shape[-1]), right.shape[1]),
            (False, True),
        )
    if packet in _MATMULS:
        left, right = args[_MATMULS[packet] : _MATMULS[packet] + 2]
        shape = math.prod(left.shape[:-2]), *left.shape[-2:], right.shape[-1]
        return Work("matmul", dtype, shape, (left.stride(-1) > 1, right.stride(-1) > 1))
    if "conv" in func.name():
        return _convolution(func.name(), dtype, args, made)
    if "scaled_dot_product" in func.name():
        backward = "backward" in func.name()
        query, key = args[int(backward) : int(backward) + 2]
        shape = math.prod(query.shape[:-2]), query.shape[-2], key.shape[-2], query.shape[-1]
        return Work("attention", dtype, shape, (backward,))
    if not computes or func.name().startswith(("aten::empty", "aten::new_empty")):
        return Work("view", dtype)
    return Work("pointwise", dtype, (sum(tensor.nbytes for tensor in (*given, *made)),))


def _convolution(name: str, dtype: torch.dtype, args: Any, made: list[Tensor]) -> Work:
    """The matrix products of a convolution, or of its gradients."""
    if "backward" in name:  # of gradient, input, weight, ..., which of input and weight need one
        (out, given, weight), times = args[:3], sum(args[-1][:2])
        transposed = args[7]
    else:  # in inference mode conv_transpose2d has another name, and no flag
        (given, weight), out, times = args[:2], made[0], 1
        transposed = "transpose" in name or (name == "aten::convolution" and args[6])
    rows = (given if transposed else out).numel() // len(weight)
    shape = times, rows, weight.numel() // len(weight), len(weight)
    return Work("matmul", dtype, shape, (False, True))


@contextmanager
def _without_numbers(counting: _Counting) -> Iterator[None]:
    from torch._subclasses.fake_tensor import FakeTensorMode  # takes a second to import

    def as_array(tensor: Tensor, **_: object) -> Tensor:
        counting.found.compiled = True
        return tensor

    changes = (
        (Tensor, "numpy", as_array),
        (torch, "from_numpy", lambda tensor: tensor),
        (nn.Module, "to", lambda module, *_, **__: module),
    )
    code = in_threads.__code__
    with ExitStack() as context:
        # The code of the function, as modules hold references to it and are imported late.
        context.callback(setattr, in_threads, "__code__", code)
        in_threads.__code__ = (lambda unit, work: None).__code__
        for owner, name, instead in changes:
            context.enter_context(patch.object(owner, name, instead))
        context.enter_context(FakeTensorMode(allow_non_fake_inputs=True))
        yield
