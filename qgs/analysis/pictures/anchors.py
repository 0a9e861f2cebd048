"""Where queries look: their supports drawn onto a photo."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from PIL import Image, ImageDraw

from qgs.analysis.pictures.ellipses import Ellipses, project_support
from qgs.analysis.pictures.images import washed
from qgs.analysis.pictures.palette import INK, Color
from qgs.io.drawing import Picture
from qgs.types import Cameras, SpatialSupport

OVERSAMPLING = 3
OUTLINE_POINTS = 96


def support_picture(
    photo: Picture, support: SpatialSupport, cameras: Cameras, colors: Mapping[int, Color]
) -> Picture:
    """All centres as dots, the queries of `colors` as outlined ellipses in their colours.

    photo: the view of cameras (1, 1), at any size of its aspect. An outline that passes behind the
    camera is not drawn; its centre is, if it lies in front.
    """
    ellipses = project_support(support, cameras)
    height, width = photo.shape[:2]
    scale = OVERSAMPLING * width / cameras.size[1]
    canvas = Image.fromarray(washed(photo, 0.45)).resize(
        (width * OVERSAMPLING, height * OVERSAMPLING), Image.Resampling.BICUBIC
    )
    draw = ImageDraw.Draw(canvas, "RGBA")
    for index in torch.argsort(ellipses.depths, descending=True).tolist():
        if index not in colors:
            _draw_center(draw, ellipses, index, scale, INK, 1.5)
    for index, color in colors.items():
        _draw_outline(draw, ellipses, index, scale, color)
        _draw_center(draw, ellipses, index, scale, color, 3.0)
    return np.asarray(canvas.resize((width, height), Image.Resampling.LANCZOS))


def _draw_center(
    draw: ImageDraw.ImageDraw,
    ellipses: Ellipses,
    index: int,
    scale: float,
    color: Color,
    radius: float,
) -> None:
    if ellipses.depths[index] <= 0:
        return
    x, y = (ellipses.points[index] * scale).clamp(-1e5, 1e5).tolist()
    r = radius * OVERSAMPLING
    draw.ellipse((x - r, y - r, x + r, y + r), fill=(*color, 190))


def _draw_outline(
    draw: ImageDraw.ImageDraw, ellipses: Ellipses, index: int, scale: float, color: Color
) -> None:
    if not ellipses.whole[index]:
        return
    angle = torch.linspace(0, 2 * torch.pi, OUTLINE_POINTS)
    circle = torch.stack([angle.cos(), angle.sin()])
    outline = (ellipses.centers[index][:, None] + ellipses.axes[index] @ circle) * scale
    points = [tuple(point) for point in outline.T.clamp(-1e5, 1e5).tolist()]
    draw.polygon(points, fill=(*color, 22))
    draw.line(points, fill=(*color, 255), width=2 * OVERSAMPLING, joint="curve")
