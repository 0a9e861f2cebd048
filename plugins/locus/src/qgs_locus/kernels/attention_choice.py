"""Choice of the code that computes attention with a bias that depends on query and token.

On a CPU, attention is computed block by block. On a GPU, torch's attention is used if the bias of
all pairs of query and token needs at most 1 / SHARE of the GPU's memory in one layer. Every layer
keeps this bias for the backward pass. For larger sizes, Triton kernels are used, or blocks if
Triton cannot be used. The speeds of these three have not been compared on a GPU. The choice depends
on sizes only, so all layers, steps and processes make the same choice.
"""

import os
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from qgs.wording import warn_once

if TYPE_CHECKING:
    from qgs_locus.kernels.attention_bias import AttentionBias

AttentionKernel = Literal["auto", "plain", "blocks", "triton"]
"""Code that computes attention with a bias.

auto: chosen by size. plain: torch's attention with the bias of all pairs of query and token.
blocks: torch, for some queries at a time. triton: Triton kernels, which never store the bias.
"""

SHARE = 16


def chosen_kernel(
    q_BhNd: Tensor, bias: "AttentionBias", kernel: AttentionKernel
) -> AttentionKernel:
    """Return `kernel`, or the kernel chosen by size if `kernel` is "auto".

    Raises ValueError for "triton" if Triton cannot compute this attention.
    """
    if kernel == "triton" and not fits_triton(q_BhNd, bias):
        raise ValueError(
            "Triton kernels cannot compute this attention: they need triton 3.5, a GPU, LocusGS's "
            "bias, tokens without gradient, heads of at most 256 channels, and no float64; use "
            'kernel="auto"'
        )
    if kernel != "auto":
        return kernel
    if q_BhNd.device.type != "cuda":
        return "blocks"
    if plain_bytes(q_BhNd, bias) * SHARE <= torch.cuda.mem_get_info(q_BhNd.device)[1]:
        return "plain"
    found = "triton" if fits_triton(q_BhNd, bias) else "blocks"
    warn_once(f"attention uses {found}: the bias of all queries and tokens needs too much memory")
    return found


def plain_bytes(q_BhNd: Tensor, bias: "AttentionBias") -> int:
    """Return the bytes that plain attention needs for the bias and, for each head, its gradient."""
    scenes, heads, queries, _ = q_BhNd.shape
    read = q_BhNd.element_size()
    each = bias.queries.element_size()
    # Attention also reads a copy in the dtype of the queries.
    if q_BhNd.dtype != bias.queries.dtype:
        each += read
    # Torch computes the gradient of the mask for each head.
    if torch.is_grad_enabled() and (bias.queries.requires_grad or bias.tokens.requires_grad):
        each += heads * read
    return scenes * queries * bias.tokens.shape[2] * each


def fits_triton(q_BhNd: Tensor, bias: "AttentionBias") -> bool:
    """Return whether the Triton kernels are installed and can compute this attention."""
    # The interpreter runs the kernels on a CPU, which tests do.
    there = q_BhNd.device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1"
    # Blocks of wider heads do not fit into registers.
    return (
        there
        and triton_version() >= (3, 5)
        and bias.in_triton
        and not (bias.tokens.requires_grad and torch.is_grad_enabled())
        and q_BhNd.dtype in (torch.float32, torch.bfloat16, torch.float16)
        and q_BhNd.shape[-1] <= 256
    )


@cache
def triton_version() -> tuple[int, ...]:
    """Return (major, minor) of the installed triton, or () if it is not installed."""
    if find_spec("triton") is None:
        return ()
    return tuple(map(int, import_module("triton").__version__.split(".")[:2]))
