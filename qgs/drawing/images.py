"""Pictures from tensors of RGB, depth or other values, and their PNG and GIF files.

A picture is an array (H, W, 3) of uint8.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from qgs.files import replacing
from qgs.types import Cameras

# uint8 (H, W, 3)
Picture = np.ndarray
# Colour of pixels without depth or attention.
NOTHING = (232, 233, 235)
DEPTH_MAP = "viridis_r"
# Pixels between pictures in a row.
GAP = 4
# Of a GIF.
FRAMES_PER_SECOND = 12


def rgb_picture(image: Tensor) -> Picture:
    """Convert an RGB tensor (3, H, W), clipped to [0, 1], to a picture."""
    return image.detach().float().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).cpu().numpy()


def depth_picture(depth: Tensor, near: float, far: float) -> Picture:
    """Draw a depth map (1, H, W) in colours from light at `near` to dark at `far`.

    Pixels of depth 0 (unknown) are grey.
    """
    picture = shaded(depth, near, far, DEPTH_MAP)
    picture[(depth[0] <= 0).cpu().numpy()] = NOTHING
    return picture


def shaded(values: Tensor, low: float, high: float, colors: str) -> Picture:
    """Draw values (1, H, W) in colours from `low` to `high`.

    colors: name of a Matplotlib colormap.
    """
    from matplotlib import colormaps

    shade = (values.detach().float().cpu().numpy()[0] - low) / max(high - low, 1e-12)
    return (colormaps[colors](shade.clip(0, 1))[..., :3] * 255).round().astype(np.uint8)


def depth_range(depths: Tensor) -> tuple[float, float]:
    """Return 2nd and 98th percentile of the depths above 0, as limits of a colour scale.

    Without depths above 0, return 0 and 1.
    """
    seen = depths[depths > 0].float()
    if not seen.numel():
        return 0.0, 1.0
    # A few far pixels would make everything else one colour.
    near, far = torch.quantile(seen.cpu(), torch.tensor([0.02, 0.98])).tolist()
    return near, far


def side_by_side(pictures: list[Picture]) -> Picture:
    """Join pictures of equal height into one row, with white gaps between."""
    left = ((0, 0), (GAP, 0), (0, 0))
    padded = [np.pad(picture, left, constant_values=255) for picture in pictures]
    return np.concatenate(padded, 1)[:, GAP:]


def png_bytes(picture: Picture) -> bytes:
    """Encode a picture as the bytes of a PNG file."""
    buffer = BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG")
    return buffer.getvalue()


def write_png(picture: Picture, path: str | Path) -> None:
    """Write a picture to `path` as PNG."""
    with replacing(path) as temporary:
        temporary.write_bytes(png_bytes(picture))


def write_gif(frames: Sequence[Picture], path: str | Path) -> None:
    """Write pictures of equal size as a looping GIF. All frames share one palette."""
    # One palette for all: others would make still pixels flicker.
    sample = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 8)]))
    palette = sample.quantize(256, method=Image.Quantize.MEDIANCUT)
    first, *rest = [
        Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames
    ]
    milliseconds = round(1000 / FRAMES_PER_SECOND)
    with replacing(path) as temporary:
        first.save(
            temporary, "GIF", save_all=True, append_images=rest, duration=milliseconds, loop=0
        )


def finer(cameras: Cameras, side: int) -> Cameras:
    """Return `cameras` with larger images, whose longer side is about `side` pixels.

    Both sides grow by the same whole factor; images are never made smaller.
    """
    height, width = cameras.size
    factor = max(1, round(side / max(height, width)))
    return Cameras(cameras.c2w, cameras.intrinsics * factor, (height * factor, width * factor))
