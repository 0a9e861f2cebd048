"""Which device a command computes on."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import torch

DEVICES = ("auto", "cpu", "cuda")


def choose_device(wanted: str = "auto", say: Callable[[str], None] = print) -> str:
    """ "cpu" or "cuda" for one of DEVICES.

    "auto" takes CUDA when there is such a device and gsplat, the renderer for it, is installed;
    where only gsplat is missing, `say` is told. Raises ValueError for another name, or for "cuda"
    without such a device.
    """
    if wanted not in DEVICES:
        raise ValueError(f"the device must be one of {', '.join(DEVICES)}, got {wanted!r}")
    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        raise ValueError(
            "the device 'cuda' was asked for, but torch finds none: install a torch with CUDA and "
            "its driver, or choose 'cpu'"
        )
    if wanted != "auto":
        return wanted
    if available and find_spec("gsplat") is None:
        say(
            "Computing on the CPU although a CUDA device is there: its renderer, gsplat, is not "
            "installed (`pip install qgs[gsplat]`, or --device cuda for recipes with another one)"
        )
        return "cpu"
    return "cuda" if available else "cpu"
