"""Attention with a bias that is a function, in drawn cases, and what is wrong with its kernels."""

import torch
import torch.nn.functional as F


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
