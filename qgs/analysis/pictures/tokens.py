"""The Gaussians of single tokens, picked out of their scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from einops import rearrange
from PIL import Image, ImageDraw
from torch import Tensor

from qgs.analysis.pictures.images import washed
from qgs.analysis.pictures.palette import INK, Color, categorical
from qgs.geometry.projection import to_camera, to_pixels
from qgs.io.drawing import Picture, rgb_picture
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians

OVERSAMPLING = 3


@dataclass(frozen=True)
class Token:
    """A query whose Gaussians are shown.

    weight: pixels it accounts for, the sum of its blending weights. spread: mean distance of its
    Gaussians to their centroid, world units.
    """

    query: int
    color: Color
    weight: float
    spread: float


def rendered_weights(model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Blending weight of each Gaussian, summed over all pixels of all cameras: (B, G), in pixels.

    A render is linear in the colours, so this is the gradient of its sum, for any renderer.
    """
    colors = gaussians.colors.detach().clone().requires_grad_()
    with torch.enable_grad():
        rgb = model.render(replace(gaussians, colors=colors), cameras).rgb
        (gradient,) = torch.autograd.grad(rgb.sum(), colors)
    return gradient.mean(-1)


def notable_tokens(
    model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras, count: int
) -> list[Token]:
    """`count` tokens that matter to cameras (1, V) and stand apart, the heaviest first.

    Of the heaviest eighth, each next token is the one farthest from those already taken, by the
    pixel of its weighted centroid in the first camera.
    """
    queries = model.queries.count
    weights_NK = rearrange(
        rendered_weights(model, gaussians, cameras)[0], "(n k) -> n k", n=queries
    )
    means_NK3 = rearrange(gaussians.means[0], "(n k) c -> n k c", n=queries)
    weights = weights_NK.sum(1)
    candidates = weights.topk(min(max(queries // 8, 2 * count), queries)).indices
    share_CK = weights_NK[candidates] / weights[candidates, None].clamp_min(1e-12)
    centres = (means_NK3[candidates] * share_CK[..., None]).sum(1)
    chosen = _spread_out(_pixels(centres, cameras[:, :1]), count)
    return [
        Token(
            query=int(candidates[index]),
            color=categorical(rank),
            weight=float(weights[candidates[index]]),
            spread=float(_spread(means_NK3[candidates[index]])),
        )
        for rank, index in enumerate(chosen)
    ]


def token_picture(
    model: QueryGaussianModel, gaussians: Gaussians, tokens: Sequence[Token], cameras: Cameras
) -> Picture:
    """The scene in pale grey, the Gaussians of `tokens` in their colours, on top of everything.

    cameras (1, 1). Lines join each Gaussian in front of the camera to its token's centroid.
    """
    scene = rgb_picture(model.render(gaussians, cameras).rgb[0, 0])
    painted = model.render(
        _painted(gaussians, tokens, model.queries.count), cameras, torch.zeros(3)
    )
    alpha = painted.alpha[0, 0, 0].cpu().numpy()[..., None]
    color = painted.rgb[0, 0].permute(1, 2, 0).cpu().numpy() * 255
    picture = washed(scene) * (1 - alpha) + color
    picture = picture.clip(0, 255).round().astype(np.uint8)
    return _with_stars(
        picture, _token_means(gaussians, tokens, model.queries.count), tokens, cameras
    )


def _token_means(gaussians: Gaussians, tokens: Sequence[Token], queries: int) -> Tensor:
    means = rearrange(gaussians.means[0], "(n k) c -> n k c", n=queries)
    return means[torch.tensor([token.query for token in tokens], dtype=torch.long)]


def _painted(gaussians: Gaussians, tokens: Sequence[Token], queries: int) -> Gaussians:
    """Only the Gaussians of `tokens`, in their colours, opaque enough to be seen."""
    per_query = gaussians.count // queries
    starts = torch.tensor([token.query * per_query for token in tokens], dtype=torch.long)
    index = (starts[:, None] + torch.arange(per_query)).flatten().to(gaussians.means.device)
    shown = gaussians[:, index]
    paint = torch.tensor([token.color for token in tokens]).view(-1, 3).to(shown.colors) / 255
    colors = paint.repeat_interleave(per_query, 0)[None]
    return replace(shown, colors=colors, opacities=shown.opacities.clamp_min(0.5))


def _with_stars(
    picture: Picture, means_TK3: Tensor, tokens: Sequence[Token], cameras: Cameras
) -> Picture:
    scale = OVERSAMPLING
    large = Image.fromarray(picture).resize(
        (picture.shape[1] * scale, picture.shape[0] * scale), Image.Resampling.BICUBIC
    )
    draw = ImageDraw.Draw(large, "RGBA")
    for means, token in zip(means_TK3, tokens, strict=True):
        front = to_camera(means[None], cameras)[0, 0, :, 2] > 1e-3
        centre = means.mean(0, keepdim=True)
        points = _pixels(torch.cat([centre, means[front]]), cameras).clamp(-1e4, 1e4) * scale
        hub, *rays = [tuple(point) for point in points.tolist()]
        for end in rays:
            draw.line([hub, end], fill=(*token.color, 200), width=scale)
        for x, y in rays:
            radius = 1.6 * scale
            box = (x - radius, y - radius, x + radius, y + radius)
            draw.ellipse(box, fill=(*token.color, 255), outline=(*INK, 160))
    return np.asarray(large.resize(picture.shape[1::-1], Image.Resampling.LANCZOS))


def _pixels(points: Tensor, cameras: Cameras) -> Tensor:
    """Pixels (P, 2) of world points (P, 3) in the first of cameras (1, V), z floored at 1 mm."""
    in_camera = to_camera(points[None], cameras)[0, 0]
    in_camera = torch.cat([in_camera[:, :2], in_camera[:, 2:].clamp_min(1e-3)], -1)
    return to_pixels(in_camera, cameras.intrinsics[0, 0]).cpu()


def _spread(means_K3: Tensor) -> Tensor:
    return (means_K3 - means_K3.mean(0)).norm(dim=-1).mean()


def _spread_out(points: Tensor, count: int) -> list[int]:
    """Indices of `count` points, starting with the first, each farthest from those before."""
    chosen = [0]
    distance = (points - points[0]).norm(dim=-1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=-1))
    return chosen
