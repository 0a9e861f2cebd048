"""Components of a small model."""

import sys

import torch
from torch import nn

from qgs.contracts import ModelDims

DIMS = ModelDims(width=16, heads=2, depth=2)
AS_IT_IS = nn.Identity()


def made(component, dims=DIMS, **options):
    return component(component.Config(**options), dims)


def attended(q, k, v, q_norm=AS_IT_IS, k_norm=AS_IT_IS):
    """What queries read with two heads of 8 numbers each, head by head."""
    read = []
    for head in (slice(0, 8), slice(8, 16)):
        logits = q_norm(q[..., head]) @ k_norm(k[..., head]).mT / 8**0.5
        read.append(logits.softmax(-1) @ v[..., head])
    return torch.cat(read, -1)


@torch.no_grad()
def shaken(module, by=0.3):
    """In float64, with noise, so that nothing hides behind an initial 0."""
    for parameter in module.double().parameters():
        parameter += by * torch.randn_like(parameter)
    return module


class Code:
    """Ends the tests where it is run, as that of a stranger's file."""

    def __reduce__(self):
        return sys.exit, ()
