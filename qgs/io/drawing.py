"""Tensors to pictures: RGB, depth in colours, pictures in a row."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

Picture = np.ndarray
"""uint8 (H, W, 3)."""

NOTHING = (232, 233, 235)
"""Colour of where there is nothing to show: no depth, no attention."""

DEPTH_MAP = "viridis_r"


def rgb_picture(image: Tensor) -> Picture:
    """RGB (3, H, W), clipped to [0, 1]."""
    pixels = image.detach().float().clamp(0, 1).mul(255).round().byte()
    return pixels.permute(1, 2, 0).cpu().numpy()


def depth_picture(depth: Tensor, near: float, far: float) -> Picture:
    """Depth (1, H, W) from near (light) to far (dark); pixels without depth (0) are grey."""
    from matplotlib import colormaps

    values = depth.detach().float().cpu().numpy()[0]
    shade = np.clip((values - near) / max(far - near, 1e-12), 0, 1)
    picture = (colormaps[DEPTH_MAP](shade)[..., :3] * 255).round().astype(np.uint8)
    picture[values <= 0] = NOTHING
    return picture


def depth_range(depths: Tensor) -> tuple[float, float]:
    """The 2nd and 98th percentile of all depths that are not 0, for a scale that pictures share."""
    seen = depths.detach()[depths.detach() > 0].float()
    if seen.numel() == 0:
        return 0.0, 1.0
    near, far = torch.quantile(seen.cpu(), torch.tensor([0.02, 0.98])).tolist()
    return near, far


def side_by_side(pictures: list[Picture], gap: int = 4) -> Picture:
    """Pictures of one height in a row, white between them."""
    height = pictures[0].shape[0]
    spacer = np.full((height, gap, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (picture, spacer)]
    return np.concatenate(parts[:-1], 1)
