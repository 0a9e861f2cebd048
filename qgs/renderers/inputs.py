"""What renderers share: checks of inputs, one precision, colours that are seen, the background."""

import torch
from torch import Tensor

from qgs.geometry.harmonics import seen_colors
from qgs.types import Cameras, Gaussians


def check_inputs(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raise ValueError unless Gaussians (B, G) and cameras (B, V) belong together."""
    if gaussians.means.ndim != 3:
        raise ValueError(
            f"a renderer takes Gaussians of B scenes, means (B, G, 3), got "
            f"{tuple(gaussians.means.shape)}; add a leading dimension for a single scene"
        )
    if len(cameras.shape) != 2:
        raise ValueError(
            f"a renderer takes cameras of shape (B, V), got {tuple(cameras.shape)}; "
            "add leading dimensions for a single scene or view"
        )
    if gaussians.means.shape[0] != cameras.shape[0]:
        raise ValueError(
            f"Gaussians of {gaussians.means.shape[0]} scenes cannot be rendered from cameras of "
            f"{cameras.shape[0]} scenes; both need the same batch size"
        )
    if gaussians.means.device != cameras.c2w.device:
        raise ValueError(
            f"Gaussians are on {gaussians.means.device}, cameras on {cameras.c2w.device}; "
            "move one with .to(device)"
        )


def raise_precision(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
    """Both as float64 if the means are, as float32 otherwise."""
    dtype = torch.promote_types(gaussians.means.dtype, torch.float32)
    return gaussians.to(dtype), cameras.to(dtype)


def colors_of(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Colours (B, G, 3), or (B, V, G, 3) where they depend on the direction."""
    return gaussians.colors if gaussians.sh is None else seen_colors(gaussians, cameras)


def background_of(
    background: Tensor | None, configured: tuple[float, float, float], like: Tensor
) -> Tensor:
    """The background RGB (3,) in the dtype and on the device of `like`."""
    if background is None:
        return torch.tensor(configured, dtype=like.dtype, device=like.device)
    if background.shape != (3,):
        raise ValueError(f"background must be one RGB of shape (3,), got {tuple(background.shape)}")
    return background.to(like)
