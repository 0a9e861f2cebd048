"""One training process among several: what they share, and tensors that lie in shards."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

from accelerate import Accelerator
from accelerate.utils import InitProcessGroupKwargs
from torch import Tensor, nn
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from qgs.model import QueryGaussianModel

PATIENCE = timedelta(hours=24)
"""How long processes wait for each other: while one evaluates or saves, the others do.

torch's own 10 minutes with NCCL would end such runs. A process that died is none of this: the
launcher notices it and ends the others.
"""


def make_accelerator(device: str) -> Accelerator:
    """The processes that `accelerate launch` or `torchrun` started, or this one alone.

    device: "cpu" or "cuda". Autocast is the trainer's own, so no mixed precision is asked for.
    """
    patience = InitProcessGroupKwargs(timeout=PATIENCE)
    return Accelerator(cpu=device == "cpu", mixed_precision="no", kwargs_handlers=[patience])


def wants_shards(accelerator: Accelerator) -> bool:
    """Whether `accelerate launch --use_fsdp` started several processes."""
    asked = os.environ.get("ACCELERATE_USE_FSDP", "false").lower() in ("1", "true")
    return asked and accelerator.num_processes > 1


def shard(model: QueryGaussianModel) -> None:
    """Lay the parameters of `model` in shards over all processes (FSDP2), in place.

    Each decoder layer gathers its weights when it runs; the rest is gathered for the whole pass.
    Parameters without a dimension to cut stay whole on every process, see `average_gradients`.
    """
    scalars = {parameter for parameter in model.parameters() if parameter.ndim == 0}
    for layer in model.decoder:
        fully_shard(layer, ignored_params=scalars)
    fully_shard(model, ignored_params=scalars)


def sharded(module: nn.Module) -> list[FSDPModule]:
    """The modules inside `module` whose parameters `shard` laid in shards."""
    return [inner for inner in module.modules() if isinstance(inner, FSDPModule)]


@contextmanager
def unsynchronised(accelerator: Accelerator, module: nn.Module) -> Iterator[None]:
    """Leave gradients unshared between processes for the `with` block; a later pass shares them."""
    shards = sharded(module)
    for inner in shards:
        inner.set_requires_gradient_sync(False, recurse=False)
    try:
        with accelerator.no_sync(module):
            yield
    finally:
        for inner in shards:
            inner.set_requires_gradient_sync(True, recurse=False)


def average_gradients(accelerator: Accelerator, module: nn.Module) -> None:
    """Average the gradients of parameters that are whole beside others in shards."""
    if not sharded(module):
        return
    for parameter in module.parameters():
        if parameter.grad is not None and not isinstance(parameter, DTensor):
            parameter.grad.copy_(mean(accelerator, parameter.grad))


def mean(accelerator: Accelerator, value: Tensor) -> Tensor:
    """Mean of `value` over processes."""
    reduced = accelerator.reduce(value, "mean")
    assert isinstance(reduced, Tensor)
    return reduced


def whole(tensor: Tensor) -> Tensor:
    """`tensor` without gradient; where processes hold shards of it, gathered, in host memory.

    All processes must call this.
    """
    tensor = tensor.detach()
    return tensor.full_tensor().cpu() if isinstance(tensor, DTensor) else tensor


def placed_like(tensor: Tensor, other: Tensor) -> Tensor:
    """The whole `tensor` on the device of `other`, as shards where `other` lies in shards."""
    tensor = tensor.to(other.device)
    if isinstance(other, DTensor) and tensor.shape == other.shape:
        mesh, placements = other.device_mesh, other.placements
        return distribute_tensor(tensor, mesh, placements, src_data_rank=None)
    return tensor
