"""One training process among several: what they share, and tensors that lie in shards."""

from __future__ import annotations

from accelerate import Accelerator
from torch import Tensor
from torch.distributed.tensor import DTensor, distribute_tensor


def make_accelerator(device: str) -> Accelerator:
    """The processes that `accelerate launch` or `torchrun` started, or this one alone.

    device: "cpu" or "cuda". Autocast is the trainer's own, so no mixed precision is asked for.
    """
    return Accelerator(cpu=device == "cpu", mixed_precision="no")


def mean(accelerator: Accelerator, value: Tensor) -> Tensor:
    """Mean of `value` over processes."""
    reduced = accelerator.reduce(value, "mean")
    assert isinstance(reduced, Tensor)
    return reduced


def whole(tensor: Tensor) -> Tensor:
    """`tensor` without gradient, gathered where processes hold shards of it; all must call this."""
    tensor = tensor.detach()
    return tensor.full_tensor() if isinstance(tensor, DTensor) else tensor


def placed_like(tensor: Tensor, other: Tensor) -> Tensor:
    """The whole `tensor` on the device of `other`, as shards where `other` lies in shards."""
    tensor = tensor.to(other.device)
    if isinstance(other, DTensor) and tensor.shape == other.shape:
        mesh, placements = other.device_mesh, other.placements
        return distribute_tensor(tensor, mesh, placements, src_data_rank=None)
    return tensor
