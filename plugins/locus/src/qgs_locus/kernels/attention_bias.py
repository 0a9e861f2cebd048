"""Attention with a bias that depends on query and token, computed block by block.

The logits are q k / sqrt(d) + b, with b the bias. To save memory, the logits, b and their gradients
never exist for all N x M pairs of query and token. They exist for one block at a time, which has
some queries and all tokens. The backward pass computes b again, and the attention weights as
exp(logits - lse), with lse the log-sum-exp of each query. FlashAttention (arXiv 2205.14135, section
3.1) does this too, and splits the tokens as well.

Axes: F numbers per query and G numbers per token, from which b is computed; n queries of a block.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import cache
from importlib import import_module
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.attention import SDPBackend, sdpa_kernel

from qgs.machine import in_threads
from qgs.precision import full_precision
from qgs_locus.kernels.attention_choice import AttentionKernel, chosen_kernel

T = TypeVar("T")
Value = Callable[[Tensor, Tensor], Tensor]
"""Function of n queries' numbers (n, F) and all tokens' numbers (G, M): the bias (n, M)."""
Block = tuple[int, slice, tuple[Tensor, ...]]
"""Block: index of the scene, slice of its queries, and buffers (n, M) for these n queries."""

BLOCK = {"cpu": 2**22, "cuda": 2**25}
"""Largest total number of elements in the buffers (n, M) of a block, by device type.

Buffers of this size fit into the caches of a CPU, and are large enough to keep a GPU busy.
"""

_kept = threading.local()

# Pairs that are worth a thread: about 0.1 ms of work.
_UNIT = 2**20
# Pairs whose `value` is computed at a time: it may need ten times the memory.
_PART = 2**21

_WITHOUT_CUDNN = [SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]


class AttentionBias(ABC):
    """Bias of attention logits, computed from F numbers of a query and G numbers of a token.

    The bias is the same for all heads. queries: numbers of all queries (B, N, F). tokens: numbers
    of all tokens (B, G, M). Both are float32 or float64, and only these two tensors get gradients.
    """

    in_triton = False
    """True if the kernels of `attention_triton` can compute this bias."""
    kernels = ""
    """Name of a module with two kernels (`qgs.kernels.kernel`) for float32 on a CPU; "" for none.

    `write` takes arrays (queries, tokens, out) and writes the bias (n, M) to `out`. `gradients`
    takes (queries, tokens, gradient, out): `gradient` is that of the bias (n, M), and the kernel
    writes the gradient of the queries (n, F) to `out`. Several threads may run a kernel at the same
    time, each on other queries.
    """

    def __init__(self, queries: Tensor, tokens: Tensor) -> None:
        self.queries = queries
        self.tokens = tokens

    @staticmethod
    @abstractmethod
    def value(queries_nF: Tensor, tokens_GM: Tensor) -> Tensor:
        """Return the bias (n, M) of n queries and all tokens of a scene, differentiable."""

    @full_precision
    def write(self, queries_nF: Tensor, tokens_GM: Tensor, out_nM: Tensor) -> None:
        """Write the bias (n, M) of n queries and all tokens of a scene into `out_nM`."""
        kernels = self._kernels(queries_nF)
        # Kernels need no (n, M, 3) tensors: they work in registers.
        if kernels is not None:
            return _in_rows(kernels.write, tokens_GM, queries_nF, out_nM)
        for part_nF, out in _parts(queries_nF, out_nM):
            out.copy_(self.value(part_nF, tokens_GM))

    @full_precision
    def gradients(
        self, queries_nF: Tensor, tokens_GM: Tensor, gradient_nM: Tensor
    ) -> tuple[Tensor | None, Tensor | None]:
        """Return the gradients of the loss with respect to `queries_nF` and `tokens_GM`.

        A gradient is None if it is not needed: if `requires_grad` of `self.queries` or of
        `self.tokens` is False. At least one of these must be True. gradient_nM: gradient of the
        loss with respect to the bias.
        """
        of_queries = self.queries.requires_grad
        of_tokens = self.tokens.requires_grad
        # Kernels compute no gradient of tokens: rays are data, unless poses are optimised.
        kernels = None if of_tokens else self._kernels(queries_nF)
        if kernels is not None:
            out_nF = torch.empty_like(queries_nF)
            _in_rows(kernels.gradients, tokens_GM, queries_nF, gradient_nM, out_nF)
            return out_nF, None
        found: list[tuple[Tensor, ...]] = []
        for part_nF, part_nM in _parts(queries_nF, gradient_nM):
            # A backward pass runs with gradients off.
            with torch.enable_grad():
                leaves = (
                    part_nF.detach().requires_grad_(of_queries),
                    tokens_GM.detach().requires_grad_(of_tokens),
                )
                value_nM = self.value(*leaves)
            given = [leaf for leaf in leaves if leaf.requires_grad], part_nM.to(value_nM)
            found.append(torch.autograd.grad(value_nM, *given, materialize_grads=True))
        parts = list(zip(*found, strict=True))
        summed_GM = torch.stack(parts[-1]).sum(0) if of_tokens else None
        return torch.cat(parts[0]) if of_queries else None, summed_GM

    def _kernels(self, queries: Tensor) -> Any:
        usable = self.kernels and queries.device.type == "cpu" and queries.dtype == torch.float32
        # It needs numba.
        return import_module(self.kernels) if usable else None

    def dense(self, chosen: Tensor | slice = slice(None)) -> Tensor:
        """Return the bias (B, N, M) of all queries, or (B, Q, M) of the Q queries `chosen`.

        chosen: indices (Q,) of queries.
        """
        queries = self.queries[:, chosen]
        return attention_mask(self.value, queries, self.tokens, queries.dtype)

    def blocks(self, buffers: int, dtype: torch.dtype) -> Iterator[Block]:
        """Yield all queries block by block, each with `buffers` tensors (n, M) to write to."""
        scenes, count, _ = self.queries.shape
        tokens = self.tokens.shape[2]
        device = self.queries.device
        # At least one query per block, for any number of tokens.
        numbers = BLOCK.get(device.type, BLOCK["cuda"])
        rows = min(max(numbers // max(buffers * tokens, tokens, 1), 1), max(count, 1))
        memory = _scratch(buffers * rows * tokens, device, dtype).view(buffers, rows, tokens)
        for scene in range(scenes):
            for first in range(0, count, rows):
                of_block = slice(first, min(first + rows, count))
                yield scene, of_block, memory[:, : of_block.stop - first].unbind()


def _parts(queries_nF: Tensor, of_pairs_nM: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Split queries (n, F) and values (n, M) along axis n; yield parts of about `_PART` values."""
    rows = max(_PART // max(of_pairs_nM.shape[1], 1), 1)
    return zip(queries_nF.split(rows), of_pairs_nM.split(rows), strict=True)


def _in_rows(kernel: Callable[..., None], tokens_GM: Tensor, *of_rows: Tensor) -> None:
    """Call a kernel on several threads, each with all tokens and some rows of the other tensors."""
    tokens = tokens_GM.numpy()
    count = len(of_rows[0])
    pairs = count * tokens.shape[1]
    threads = min(torch.get_num_threads(), -(-pairs // _UNIT)) or 1
    step = -(-count // threads)
    parts = zip(*(x.split(step) for x in of_rows), strict=True)
    in_threads(kernel, [(q.numpy(), tokens, *(x.numpy() for x in more)) for q, *more in parts])


def _scratch(size: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return uninitialised memory for `size` numbers; the next call may return it again."""
    if device.type != "cpu":
        return torch.empty(size, device=device, dtype=dtype)
    # Memory is kept: touching new memory takes as long as computing the bias.
    memory = getattr(_kept, "memory", None)
    if memory is None or memory.dtype != dtype or len(memory) < size:
        # A later pass may need gradients.
        with torch.inference_mode(False):
            memory = _kept.memory = torch.empty(size, dtype=dtype)
    return memory[:size]


def biased_attention(
    q_BhNd: Tensor,
    k_BhMd: Tensor,
    v_BhMd: Tensor,
    bias: AttentionBias,
    kernel: AttentionKernel = "auto",
) -> Tensor:
    """Return attention softmax(q k / sqrt(d) + b) v, (B, h, N, d), with the bias b.

    Raises ValueError if `kernel` cannot compute this attention.
    """
    qkv = (q_BhNd, k_BhMd, v_BhMd)
    of_bias = (bias.queries, bias.tokens)
    chosen = chosen_kernel(q_BhNd, bias, kernel)
    if chosen == "plain":
        eager = q_BhNd.device.type == "cpu" or torch.compiler.is_compiling()
        mask = attention_mask if eager else _compiled_mask()
        mask_BNM = mask(bias.value, *of_bias, q_BhNd.dtype)
        # cuDNN's gradients would be NaN (pytorch issue 196678).
        faulty = torch.is_grad_enabled() and k_BhMd.shape[2] % 128 == 64
        with sdpa_kernel(_WITHOUT_CUDNN) if faulty else nullcontext():
            return F.scaled_dot_product_attention(*qkv, attn_mask=mask_BNM[:, None])
    if chosen == "triton":
        from qgs_locus.kernels.attention_triton import attention  # needs triton

        # Kernels assume that rows of these are contiguous.
        return attention(*qkv, *(x.contiguous() for x in of_bias))[0]
    return _outside_graphs(_BiasedAttention.apply)(*qkv, *of_bias, bias)


def attention_mask(value: Value, queries: Tensor, tokens: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the bias (B, N, M) of all queries and tokens in `dtype`, differentiable."""
    # Not by `full_precision`, whose code, and so whose limit of compilations, many functions share.
    with torch.autocast(queries.device.type, enabled=False):
        return torch.vmap(value)(queries, tokens).to(dtype)


@cache
def _compiled_mask() -> Callable[[Value, Tensor, Tensor, torch.dtype], Tensor]:
    """Return `attention_mask` as one kernel, for gradients with a bool for each pair."""
    return torch.compile(attention_mask, dynamic=True)


def _outside_graphs(function: Callable[..., T]) -> Callable[..., T]:
    """Keep `function` out of graphs of torch.compile, which would unroll its loop for every size.

    If nothing is being compiled, return the function unchanged: `torch.compiler.disable` would
    import the compiler, which takes 0.8 s.
    """
    outside: Any = torch.compiler.disable if torch.compiler.is_compiling() else lambda f: f
    return outside(function)


class _BiasGradients:
    """Gradients of the queries and tokens of an `AttentionBias`, summed over blocks.

    A gradient that is not needed stays zero.
    """

    def __init__(self, queries: Tensor, tokens: Tensor, bias: AttentionBias) -> None:
        self._read = (queries, tokens)
        self._bias = bias
        self.queries = torch.zeros_like(queries)
        self.tokens = torch.zeros_like(tokens)
        self.wanted = bias.queries.requires_grad or bias.tokens.requires_grad

    def add(self, scene: int, rows: slice, gradient_nM: Tensor) -> None:
        """Add the gradients of a block of n queries, given the gradient of its bias (n, M)."""
        read = self._read[0][scene, rows], self._read[1][scene]
        of_queries, of_tokens = self._bias.gradients(*read, gradient_nM)
        if of_queries is not None:
            self.queries[scene, rows] = of_queries
        if of_tokens is not None:
            self.tokens[scene] += of_tokens


class _BiasedAttention(torch.autograd.Function):
    """Autograd function of `biased_attention`, computed for one block of queries at a time."""

    @staticmethod
    def forward(
        ctx: Any, q: Tensor, k: Tensor, v: Tensor, queries: Tensor, tokens: Tensor, bias: Any
    ) -> Tensor:
        # bfloat16 is too coarse for a log-sum-exp.
        exact = torch.promote_types(q.dtype, torch.float32)
        out = torch.empty_like(q)
        lse = q.new_empty(q.shape[:3], dtype=exact)
        # `_attend` needs the logits of all heads at once, except in the fused CPU kernel.
        heads = 0 if q.device.type == "cpu" else q.shape[1]
        for scene, rows, (bias_nM, *_) in bias.blocks(1 + heads, lse.dtype):
            bias.write(queries[scene, rows], tokens[scene], bias_nM)
            out[scene, :, rows], lse[scene, :, rows] = _attend(
                q[scene, :, rows], k[scene], v[scene], bias_nM
            )
        ctx.save_for_backward(q, k, v, queries, tokens, out, lse)
        ctx.bias = bias
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        found = _attention_gradients(saved, gradients[0], ctx.bias, ctx.needs_input_grad)
        return *(g if g is None else g.to(x) for g, x in zip(found, saved[:5], strict=True)), None


def _attend(q_hnd: Tensor, k_hMd: Tensor, v_hMd: Tensor, bias_nM: Tensor) -> tuple[Tensor, Tensor]:
    """Return attention (h, n, d) of n queries of a scene, and log-sum-exp (h, n) of the logits."""
    if q_hnd.device.type != "cpu" or (flash := _flash_for_cpu()) is None:
        return _attend_anywhere(q_hnd, k_hMd, v_hMd, bias_nM)
    out, lse = flash(q_hnd[None], k_hMd[None], v_hMd[None], attn_mask=bias_nM[None, None])
    return out[0], lse[0]


@cache
def _flash_for_cpu() -> Callable[..., tuple[Tensor, Tensor]] | None:
    """Return torch's private operator for attention on a CPU, or None if it does not work.

    Only this operator returns the log-sum-exp, which saves a softmax in the backward pass.
    """
    x = torch.ones(1, 1, 1, 8, device="cpu")
    try:
        flash: Any = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
        out, lse = flash(x, x, x, attn_mask=x[..., :1])
        return flash if (out.shape, lse.shape) == (x.shape, x.shape[:3]) else None
    except (AttributeError, RuntimeError, TypeError, ValueError):
        return None


@full_precision
def _attend_anywhere(
    q_hnd: Tensor, k_hMd: Tensor, v_hMd: Tensor, bias_nM: Tensor
) -> tuple[Tensor, Tensor]:
    """Return attention (h, n, d) and log-sum-exp (h, n), in float32 or float64, on any device."""
    logits_hnM = torch.baddbmm(bias_nM, q_hnd, k_hMd.mT, alpha=q_hnd.shape[-1] ** -0.5)
    lse_hn = logits_hnM.logsumexp(-1)
    return logits_hnM.sub_(lse_hn[..., None]).exp_() @ v_hMd, lse_hn


@full_precision
def _attention_gradients(
    saved: tuple[Tensor, ...], gradient: Tensor, bias: AttentionBias, needs: tuple[bool, ...]
) -> tuple[Tensor | None, ...]:
    """Return gradients of q, k, v (each (B, h, N or M, d)) and of the bias's queries and tokens.

    Gradients of q, k and v that are not needed are None. For a head with logits S, attention
    weights P = softmax(S), output O and its gradient dO: dV = P' dO,
    dS = P * (dO V' - rowsum(dO * O)), dQ = dS K / sqrt(d), dK = dS' Q / sqrt(d). ' transposes,
    * multiplies entries. The gradient of the bias is the sum of dS over heads.
    """
    q, k, v, queries, tokens, out, lse = saved
    scale = q.shape[-1] ** -0.5
    dq, dk, dv = (torch.zeros_like(x) if needs[n] else None for n, x in enumerate(saved[:3]))
    of_bias = _BiasGradients(queries, tokens, bias)
    # Scaled once here instead of for every pair.
    q = q * scale
    # The row sum of P * dP, which needs neither P nor dP.
    rowsum = (gradient * out).sum(-1, keepdim=True)
    for scene, rows, (b, total, p, ds) in bias.blocks(4, lse.dtype):
        bias.write(queries[scene, rows], tokens[scene], b)
        of_queries = (x[scene, :, rows] for x in (q, gradient, lse[..., None], rowsum))
        of_tokens = k[scene], v[scene]
        each_head = enumerate(zip(*of_queries, *of_tokens, strict=True))
        for head, (q_nd, do_nd, lse_n1, rowsum_n1, k_Md, v_Md) in each_head:
            # p = exp(q k + b - lse); each step writes into memory that exists already.
            torch.sub(b, lse_n1, out=p)
            p.addmm_(q_nd, k_Md.mT).exp_()
            # Frozen parts of a model need no gradient.
            if dv is not None:
                dv[scene, head].addmm_(p.mT, do_nd)
            torch.mm(do_nd, v_Md.mT, out=ds)
            ds.sub_(rowsum_n1).mul_(p)
            if dq is not None:
                dq[scene, head, rows] = ds @ k_Md
            if dk is not None:
                dk[scene, head].addmm_(ds.mT, q_nd)
            if of_bias.wanted:
                # All heads share the bias, so its gradient is their sum.
                if head == 0:
                    total.copy_(ds)
                else:
                    total.add_(ds)
        if of_bias.wanted:
            of_bias.add(scene, rows, total)
    return None if dq is None else dq.mul_(scale), dk, dv, of_bias.queries, of_bias.tokens
