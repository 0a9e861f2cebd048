"""Choice of the code that computes attention with a bias that depends on query and token.

On a CPU, attention is computed block by block. On a GPU, torch's attention is used if the bias of
all pairs of query and token needs at most 1 / SHARE of the GPU's memory in one layer. Every layer
keeps this bias for the backward pass. For larger sizes, Triton kernels are used, or blocks if
Triton cannot be used. The speeds of these three have not been compared on a GPU:
`tools/gpu_check.sh` measures them. The choice depends on sizes only, so all layers, steps and
processes make the same choice, and torch.compile makes one graph of all layers.
"""

import os
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


# Constants, so that torch.compile makes one graph of a model. Torch 2.9 comes with triton 3.5.
TRITON = find_spec("triton") is not None and torch.__version__ >= "2.9"
# The interpreter runs the kernels on a CPU, which tests do.
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


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
    gpu = torch.cuda.get_device_properties(q_BhNd.device)
    # The bias of all pairs is compiled, by Triton too, which needs tensor cores.
    compiles = TRITON and gpu.major >= 7
    if compiles and plain_bytes(q_BhNd, bias) <= gpu.total_memory // SHARE:
        return "plain"
    found = "triton" if compiles and fits_triton(q_BhNd, bias) else "blocks"
    # A warning would end the graph.
    if not torch.compiler.is_compiling():
        needed = "plain attention needs a newer GPU, Triton or more memory"
        warn_once(f"attention uses {found}: {needed}")
    return found


def plain_bytes(q_BhNd: Tensor, bias: "AttentionBias") -> int:
    """Return the bytes that plain attention needs for the bias and, for each head, its gradient."""
    scenes, heads, queries, _ = q_BhNd.shape
    learns = bias.queries.requires_grad or bias.tokens.requires_grad
    # Torch computes the gradient of the mask for each head.
    copies = 1 + heads if torch.is_grad_enabled() and learns else 1
    return scenes * queries * bias.tokens.shape[2] * q_BhNd.element_size() * copies


def fits_triton(q_BhNd: Tensor, bias: "AttentionBias") -> bool:
    """Return whether the Triton kernels are installed and can compute this attention."""
    # Blocks of wider heads do not fit into registers.
    return (
        (q_BhNd.device.type == "cuda" or INTERPRETED)
        and TRITON
        and bias.in_triton
        and not (bias.tokens.requires_grad and torch.is_grad_enabled())
        and q_BhNd.dtype in (torch.float32, torch.bfloat16, torch.float16)
        and q_BhNd.shape[-1] <= 256
    )
