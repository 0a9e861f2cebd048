"""What an operation holds in tensors, counted from shapes alone: nothing is computed or allocated.

The operation runs on tensors without numbers (torch's FakeTensorMode), while every storage that is
made or freed is counted. What autograd keeps, gradients, moments and buffers are thus those of the
very code that trains, and the peak is exact; tests hold it against the same count on real tensors.
What kernels take inside an operator, and how an allocator rounds and scatters, is not in it.
"""

import sys
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice
from threading import Thread
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from qgs.components.attention_bias import AttentionBias
from qgs.composer import Recipe
from qgs.model import QueryGaussianModel
from qgs.threads import in_threads
from qgs_bench.work import Operation, Workload, make_task

_SCALARS = torch.ops.aten._local_scalar_dense.default, torch.ops.aten.item.default


@dataclass(frozen=True)
class Counted:
    """Bytes. weights, inputs: parameters and buffers; photos and poses. peak: the most at a time.

    moments: what is there between two steps besides: the optimiser's, and buffers that threads
    keep. gradients: of the weights. kept: what each part of the model leaves for the backward pass,
    by name. Of `forward`, these three are nothing.
    """

    weights: int
    inputs: int
    gradients: int
    moments: int
    kept: dict[str, int]
    peak: int


def count(recipe: Recipe, operation: Operation, workload: Workload, fake: bool = True) -> Counted:
    """What `operation` takes, the second time of two: the first one makes the moments.

    fake: without numbers; else the operation is computed. Raises ValueError where a component
    needs numbers to go on, such as one whose shapes depend on them.
    """
    found: list[Counted | BaseException] = []

    def work() -> None:
        try:
            found.append(_count(recipe, operation, workload, fake))
        except BaseException as error:
            found.append(error)

    thread = Thread(target=work)  # buffers that threads keep are then its own
    thread.start()
    thread.join()
    (result,) = found
    if isinstance(result, Counted):
        return result
    if not fake:
        raise result
    raise ValueError(
        f"the memory of the {operation} cannot be counted from shapes alone "
        f"({type(result).__name__}: {str(result).splitlines()[0] if str(result) else ''}); measure "
        "it with --memory"
    ) from result


def _count(recipe: Recipe, operation: Operation, workload: Workload, fake: bool) -> Counted:
    model: Any = recipe.build_model("meta" if fake else "cpu")
    live = _LiveBytes(fake)
    with ExitStack() as context:
        if fake:
            context.enter_context(_shapes_alone())
            model = model.to_empty(device="cpu")
            model._warned = True  # of cameras, whose numbers are none
        context.enter_context(live)
        for tensor in (*model.parameters(), *model.buffers()):
            live.see(tensor)
        weights = live.now
        task = make_task(operation, recipe, model, workload)
        inputs = live.now - weights
        task()
        between = live.now
        live.peak, kept = live.now, _watch(model, live) if operation == "step" else {}
        task()
    trained = [p.grad.nbytes for p in model.parameters() if p.grad is not None]
    gradients = sum(trained)
    moments = max(0, between - weights - inputs - gradients) if operation == "step" else 0
    return Counted(weights, inputs, gradients, moments, dict(kept), live.peak)


def _watch(model: QueryGaussianModel, live: "_LiveBytes") -> dict[str, int]:
    """What each part of the model has added when its forward pass is over, filled in as it runs."""
    kept: dict[str, int] = {}
    for name, part in model.named_children():
        modules = part if isinstance(part, nn.ModuleList) else [part]
        for module in modules if name != "renderer" else ():
            before: list[int] = []
            module.register_forward_pre_hook(lambda *_, b=before: b.append(live.now))

            def after(*_: object, name: str = name, before: list[int] = before) -> None:
                kept[name] = kept.get(name, 0) + max(0, live.now - before.pop())

            module.register_forward_hook(after)
    return kept


class _LiveBytes(TorchDispatchMode):
    """Counts the bytes of all storages that operators make, until they are freed."""

    def __init__(self, fake: bool) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._fake = fake
        self._known: dict[int, Any] = {}

    def see(self, tensor: Tensor) -> None:
        """Count the storage of `tensor`, once, for as long as it lives."""
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key in self._known:
            return

        def freed(_: object) -> None:
            if self._known.pop(key, None) is not None:
                self.now -= size

        self._known[key] = weakref.ref(storage, freed)
        self.now += size
        self.peak = max(self.peak, self.now)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> object:
        if self._fake and func in _SCALARS:  # a number that is asked for is one, or true
            return 1.0 if args[0].is_floating_point() else args[0].dtype == torch.bool or 1
        out = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                self.see(leaf)
        return out


@contextmanager
def _shapes_alone() -> Iterator[None]:
    """Tensors without numbers; kernels of ours are not called, arrays are the tensors themselves.

    Of the blocks of an attention the first will do: it has the buffers of all.
    """
    blocks = AttentionBias.blocks
    with ExitStack() as context:
        for module in [*sys.modules.values()]:
            if vars(module).get("in_threads") is in_threads:
                context.enter_context(patch.object(module, "in_threads", lambda *_: None))
        changes = (
            (Tensor, "numpy", lambda tensor, **_: tensor),
            (torch, "from_numpy", lambda tensor: tensor),
            (nn.Module, "to", lambda module, *_, **__: module),
            (AttentionBias, "blocks", lambda *given: islice(blocks(*given), 1)),
        )
        for owner, name, instead in changes:
            context.enter_context(patch.object(owner, name, instead))
        context.enter_context(FakeTensorMode(allow_non_fake_inputs=True))
        yield
