"""Attention with a bias that is a function, in drawn cases, and what is wrong with its kernels."""

from functools import partial

import torch
import torch.nn.functional as F
from qgs_locus.kernels.attention_bias import biased_attention
from qgs_locus.ray_bias import RayBias
from torch.nn.attention.flex_attention import flex_attention


def case(sizes, factor=1.0, lower=-6.0):
    """sizes: scenes, heads, queries, tokens, numbers of a head. LocusGS's bias reads of a query its
    place, a factor of the squared distance, and the least bias."""
    scenes, heads, queries, tokens, each = sizes
    factor = factor * (0.1 + torch.rand(scenes, queries, 1))
    read = [torch.randn(scenes, queries, 3), factor, torch.ones_like(factor) * lower]
    return {
        "q": torch.randn(scenes, queries, heads, each).transpose(1, 2),
        "k": torch.randn(scenes, heads, tokens, each),
        "v": torch.randn(scenes, tokens, heads, each).transpose(1, 2),
        "queries": torch.cat(read, -1),
        "tokens": torch.randn(scenes, 6, tokens),
        "gradient": torch.randn(scenes, heads, queries, each),
    }


def direct(q, k, v, bias):
    """The formula, with all pairs at once."""
    scenes = zip(bias.queries, bias.tokens, strict=True)
    mask = torch.stack([bias.value(*read) for read in scenes])
    return F.scaled_dot_product_attention(q, k, v, mask[:, None])


def flex(q, k, v, bias):
    """By torch's FlexAttention, with LocusGS's bias in its own words."""
    queries = bias.queries.unbind(-1)
    tokens = bias.tokens.unbind(1)

    def biased(logit, scene, head, n, m):
        x, y, z, factor, lower = (numbers[scene, n] for numbers in queries)
        m0, m1, m2, d0, d1, d2 = (numbers[scene, m] for numbers in tokens)
        moments = y * d2 - z * d1 - m0, z * d0 - x * d2 - m1, x * d1 - y * d0 - m2
        return logit + torch.maximum(-factor * sum(e * e for e in moments), lower)

    return flex_attention(q, k, v, biased)


WAYS = ("no bias", "plain", "triton", "blocks", "flex")


def step_of(way, sizes):
    """Attention on a GPU in bfloat16, with gradients if they are on."""
    with torch.device("cuda"):
        given = case(sizes)
    qkv = [given[name].bfloat16().requires_grad_() for name in "qkv"]
    bias = RayBias(given["queries"].requires_grad_(), given["tokens"])
    attention = partial(biased_attention, bias=bias, kernel=way)
    if way == "no bias":
        attention = F.scaled_dot_product_attention
    if way == "flex":
        attention = partial(torch.compile(flex), bias=bias)

    def step():
        read = attention(*qkv)
        if read.requires_grad:
            read.sum().backward()

    return step


def found(attention, kind, given, learnt):
    """The result, and the gradients that there are."""
    x = {name: leaf.detach().requires_grad_(name in learnt) for name, leaf in given.items()}
    read = attention(x["q"], x["k"], x["v"], kind(x["queries"], x["tokens"]))
    read.backward(x["gradient"])
    gradients = {name: leaf.grad for name, leaf in x.items() if leaf.grad is not None}
    return {"read": read.detach(), **gradients}


def exact(kind, given, learnt):
    return found(direct, kind, {name: x.double() for name, x in given.items()}, learnt)


def wrong(seen, best, tolerance=1e-5):
    """Errors, relative to what is of order 1 or more: where most pairs reach the least bias,
    gradients are sums of numbers of order 1 that nearly cancel. What is 0 but for rounding is
    compared with ones."""
    errors = {}
    for name, x in seen.items():
        size = float(best[name].norm())
        size = max(size, 1.0) if size > 1e-10 else x.numel() ** 0.5
        errors[name] = float((x.cpu() - best[name]).norm()) / size
    return {name: error for name, error in errors.items() if not error < tolerance}
