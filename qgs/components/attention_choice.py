"""What computes attention with a bias that is a function: the tensors' device and its memory say.

On a CPU always blocks. On CUDA the plain path, with the bias of all pairs, as long as it fits into
free memory: nothing else has been timed there. Where it does not fit, kernels in Triton, or blocks
in torch where those cannot run.
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

MAX_WIDTH = 256
"""Greatest width of a head for the Triton kernels: wider blocks fit into no registers."""

LEAST_TRITON = (3, 5)

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


def chosen_kernel(
    q_BhNd: Tensor, k_BhMd: Tensor, v_BhMd: Tensor, bias: "AttentionBias", kernel: AttentionKernel
) -> AttentionKernel:
    """One that is not "auto". ValueError for "triton" where it cannot compute this."""
    if kernel == "auto" and _forced:
        kernel = _forced[-1]
    if kernel == "triton" and (hindrance := _hindrance(q_BhNd, k_BhMd, v_BhMd, bias)):
        raise ValueError(f"the Triton kernel of attention cannot be used: {hindrance}")
    if kernel != "auto":
        return kernel
    if q_BhNd.device.type != "cuda":
        return "blocks"
    needed, free = plain_bytes(q_BhNd, bias), _free_bytes(q_BhNd.device)
    if needed <= free:
        return "plain"
    hindrance = _hindrance(q_BhNd, k_BhMd, v_BhMd, bias)
    found = "blocks in torch" if hindrance else "Triton kernels"
    if found not in _said:
        _said.add(found)
        scenes, heads, queries, _ = q_BhNd.shape
        why = f", slower than Triton kernels: {hindrance}" if hindrance else ""
        _log.warning(
            f"attention of {queries:,} queries to {k_BhMd.shape[2]:,} tokens (batch {scenes}, "
            f"{heads} heads) would take {in_words(needed)} for the bias of all pairs and its "
            f"gradient, and {in_words(free)} of GPU memory are free: it goes through {found}{why}"
        )
    return "blocks" if hindrance else "triton"


def plain_bytes(q_BhNd: Tensor, bias: "AttentionBias") -> int:
    """What the plain path takes beside q, k and v: the bias, and its gradient for each head."""
    scenes, heads, queries, _ = q_BhNd.shape
    exact, read = bias.queries.element_size(), q_BhNd.element_size()
    each = exact + (read if q_BhNd.dtype != bias.queries.dtype else 0)
    trained = bias.queries.requires_grad or bias.tokens.requires_grad
    if trained and torch.is_grad_enabled():
        each += heads * read
    return scenes * queries * bias.tokens.shape[2] * each


def _free_bytes(device: torch.device) -> int:
    """GPU memory that is free, or kept by torch without use."""
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def _hindrance(q_BhNd: Tensor, k_BhMd: Tensor, v_BhMd: Tensor, bias: "AttentionBias") -> str | None:
    """Why the Triton kernels cannot compute this, and what to do; None if they can."""
    needs = ".".join(map(str, LEAST_TRITON))
    if find_spec("triton") is None:
        return f'it needs triton {needs} or newer: run `pip install "query-gaussians[triton]"`'
    version = import_module("triton").__version__
    if tuple(int(part) for part in version.split(".")[:2]) < LEAST_TRITON:
        return f"it needs triton {needs} or newer, and {version} is installed"
    if q_BhNd.device.type != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        return f"it runs on a GPU, and the tensors are on {q_BhNd.device}"
    if bias.triton_functions() is None:
        return f"{type(bias).__name__} brings no functions for it (`triton_functions`)"
    if bias.tokens.requires_grad and torch.is_grad_enabled():
        return "it has no gradients of what the bias reads of tokens, and they require one"
    types = {x.dtype for x in (q_BhNd, k_BhMd, v_BhMd)}
    if len(types) > 1 or not types <= {torch.float32, torch.bfloat16, torch.float16}:
        found = ", ".join(sorted(map(str, types)))
        return f"it takes float32, bfloat16 or float16, one for q, k and v, not {found}"
    if bias.queries.dtype != torch.float32:
        return f"it takes what a bias reads in float32, not {bias.queries.dtype}"
    if q_BhNd.shape[-1] > MAX_WIDTH:
        return f"its heads are at most {MAX_WIDTH} wide, not {q_BhNd.shape[-1]}"
    return None
