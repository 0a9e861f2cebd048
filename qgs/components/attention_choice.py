"""What computes attention with a bias that is a function.

On a CPU: blocks. On CUDA: the plain path, with the bias of all pairs, while one layer needs at most
1 / SHARE of the GPU's memory for it (every layer keeps its bias for the backward pass); for larger
sizes Triton kernels, or blocks without them. No path has been timed on a GPU. The choice depends on
sizes alone, so that layers, steps and processes of a training choose alike.
"""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal, TypeAlias

import torch
from torch import Tensor

from qgs.memory import in_words

if TYPE_CHECKING:
    from qgs.components.attention_bias import AttentionBias

AttentionKernel: TypeAlias = Literal["auto", "plain", "blocks", "triton"]
"""plain: torch's attention with the bias of all pairs. blocks: torch, block by block."""

SHARE = 16

_log = logging.getLogger(__name__)
_forced: list[AttentionKernel] = []
_said: set[str] = set()


@contextmanager
def attention_kernel(kernel: AttentionKernel) -> Iterator[None]:
    """What computes attention that leaves it open ("auto"), in all threads: to measure models."""
    _forced.append(kernel)
    try:
        yield
    finally:
        _forced.pop()


def chosen_kernel(q_BhNd: Tensor, bias: "AttentionBias", kernel: AttentionKernel) -> str:
    """One that is not "auto". ValueError for "triton" where it cannot compute this."""
    kernel = _forced[-1] if kernel == "auto" and _forced else kernel
    if kernel == "triton" and (hindrance := _hindrance(q_BhNd, bias)):
        raise ValueError(f"the Triton kernel of attention cannot be used: {hindrance}")
    if kernel != "auto":
        return kernel
    if q_BhNd.device.type != "cuda":
        return "blocks"
    needed = plain_bytes(q_BhNd, bias)
    if needed * SHARE <= torch.cuda.mem_get_info(q_BhNd.device)[1]:
        return "plain"
    hindrance = _hindrance(q_BhNd, bias)
    way = f"blocks in torch, slower than Triton: {hindrance}" if hindrance else "Triton kernels"
    if way not in _said:
        _said.add(way)
        scenes, heads, queries, _ = q_BhNd.shape
        _log.warning(
            f"attention of {queries:,} queries to {bias.tokens.shape[2]:,} tokens (batch {scenes}, "
            f"{heads} heads) would take {in_words(needed)} for the bias of all pairs and its "
            f"gradient, more than 1/{SHARE} of the GPU's memory: it goes through {way}"
        )
    return "blocks" if hindrance else "triton"


def plain_bytes(q_BhNd: Tensor, bias: "AttentionBias") -> int:
    """What the plain path takes beside q, k and v: the bias, and its gradient for each head."""
    (scenes, heads, queries, _), read = q_BhNd.shape, q_BhNd.element_size()
    each = bias.queries.element_size() + (read if q_BhNd.dtype != bias.queries.dtype else 0)
    if torch.is_grad_enabled() and (bias.queries.requires_grad or bias.tokens.requires_grad):
        each += heads * read
    return scenes * queries * bias.tokens.shape[2] * each


def _hindrance(q_BhNd: Tensor, bias: "AttentionBias") -> str | None:
    """Why the Triton kernels cannot compute this, and what to do; None if they can."""
    version = import_module("triton").__version__ if find_spec("triton") else "none"
    if version == "none" or tuple(map(int, version.split(".")[:2])) < (3, 5):
        install = 'run `pip install "query-gaussians[triton]"`'
        return f"it needs triton 3.5 or newer ({version} is installed): {install}"
    if q_BhNd.device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        return f"it runs on a GPU, and the tensors are on {q_BhNd.device}"
    if bias.triton_functions() is None:
        return f"{type(bias).__name__} brings no functions for it (`triton_functions`)"
    if bias.tokens.requires_grad and torch.is_grad_enabled():
        return "it has no gradients of what the bias reads of tokens, and they require one"
    if q_BhNd.dtype not in (torch.float32, torch.bfloat16, torch.float16):
        return f"it takes float32, bfloat16 and float16, not {q_BhNd.dtype}"
    if q_BhNd.shape[-1] > 256:  # wider blocks fit into no registers
        return f"its heads are at most 256 wide, not {q_BhNd.shape[-1]}"
    return None
