"""Draw queries on photos: anchors, support ellipsoids, attention, Gaussians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageOps
from torch import Tensor

from qgs.drawing.images import NOTHING, Picture, rgb_picture, side_by_side
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.metrics.dispersion import token_dispersion
from qgs.model import QueryGaussianModel
from qgs.precision import full_precision
from qgs.types import Cameras, Gaussians, SpatialSupport
from qgs_viewer.look import INK, Color, categorical, enlarged
from qgs_viewer.query_scene import QueryScene

ATTENTION_COLOR = categorical(0)
PARTS = {"content": "content logits", "geometry": "geometry bias", "weights": "attention"}
"""Captions of the fields of AttentionWeights."""
# Lines are drawn on pictures so many times as large, which smooths them.
OVERSAMPLING = 3
# Part of a picture along its border, where no query is chosen to be shown.
MARGIN = 0.15
OUTLINE_POINTS = 96
# Pixels from the picture's corner to which lines are drawn; Pillow fails far outside.
FARTHEST = 1e4


@full_precision
def outline(support: SpatialSupport, query: int, cameras: Cameras) -> Tensor | None:
    """Return the outline of a query's support ellipsoid in a photo: 96 pixel positions (96, 2).

    Returns None if a part of the ellipsoid lies behind the camera. cameras: (1, 1), the camera of
    the photo.

    In coordinates in which the ellipsoid is the unit ball, the outline seen from a camera at e is a
    circle with centre e / |e|^2 and radius sqrt(1 - 1 / |e|^2), in a plane at right angles to e.
    """
    center = support.centers[0, query]
    axes = support.axes[0, query]
    depth_row = cameras.w2c[0, 0, 2]
    nearest = depth_row[:3] @ center + depth_row[3] - (depth_row[:3] @ axes).norm()
    if nearest <= 0:
        return None
    eye = torch.linalg.pinv(axes) @ (cameras.c2w[0, 0, :3, 3] - center)
    inverse = 1 / eye.square().sum()
    # the rows after the first are at right angles to the direction of the camera
    across = torch.linalg.svd(eye[None]).Vh[1:]
    angles = torch.linspace(0, 2 * torch.pi, OUTLINE_POINTS).to(eye)
    ring = torch.stack([angles.cos(), angles.sin()], -1) @ across
    border = inverse * eye + (1 - inverse).clamp_min(0).sqrt() * ring
    return _pixels(center + border @ axes.mT, cameras)


def _pixels(points: Tensor, cameras: Cameras) -> Tensor:
    """Return the pixels (P, 2) of P world points (P, 3) in the first of V cameras (1, V).

    Depths in the camera below 0.001 are set to 0.001, so that points behind the camera have pixels.
    """
    in_camera = to_camera(points[None], cameras)[0, 0]
    in_camera = torch.cat([in_camera[:, :2], in_camera[:, 2:].clamp_min(1e-3)], -1)
    return to_pixels(in_camera, cameras.intrinsics[0, 0]).clamp(-FARTHEST, FARTHEST).cpu()


def washed(picture: Picture, strength: float = 0.6) -> Picture:
    """Return `picture` in grey, mixed with white, as a background to draw on.

    strength: share of white in each pixel, from 0 to 1.
    """
    grey = Image.fromarray(picture).convert("L").convert("RGB")
    return np.asarray(Image.blend(grey, Image.new("RGB", grey.size, "white"), strength))


def _reduced(image: Image.Image) -> Picture:
    """Return an image that is OVERSAMPLING times too large in its right size."""
    return np.asarray(ImageOps.scale(image, 1 / OVERSAMPLING, Image.Resampling.LANCZOS))


def support_picture(
    photo: Picture, support: SpatialSupport, cameras: Cameras, colors: Mapping[int, Color]
) -> Picture:
    """Draw all anchors as dots on a photo, and the supports of some queries as ellipses.

    cameras: (1, 1), the camera of the photo. colors: RGB colours of the queries whose support is
    drawn, by index of the query.
    """
    scale = OVERSAMPLING * photo.shape[1] / cameras.size[1]
    depths = to_camera(support.centers[:1], cameras)[0, 0, :, 2]
    places = (_pixels(support.centers[0], cameras) * scale).tolist()
    # near ones cover far ones, and the chosen ones cover all
    farthest_first = depths.argsort(descending=True).tolist()
    # colours of the photo would compete with those of the queries
    image = ImageOps.scale(Image.fromarray(washed(photo, 0.45)), OVERSAMPLING)
    draw = ImageDraw.Draw(image, "RGBA")
    for query in [*(q for q in farthest_first if q not in colors), *colors]:
        color = colors.get(query)
        border = outline(support, query, cameras) if color else None
        if color and border is not None:
            points = (border * scale).flatten().tolist()
            draw.polygon(points, fill=(*color, 22))
            draw.line(points, fill=(*color, 255), width=2 * OVERSAMPLING, joint="curve")
        if depths[query] > 0:
            size = 4.0 if color else 1.4
            rim = (255, 255, 255, 255) if color else None
            fill = (*(color or INK), 220)
            draw.circle(places[query], size * OVERSAMPLING, fill, rim, OVERSAMPLING)
    return _reduced(image)


def patch_maps(rows_hM: Tensor, grid: tuple[int, int, int]) -> np.ndarray:
    """Return attention scores, averaged over heads, as maps of V photos: (V, rows, columns).

    rows_hM: scores (h, M) of h heads for the M patches of all V photos. grid: (V, rows, columns),
    with M as product. A score of -inf is masked and left out of the mean; a patch that is masked in
    all heads is NaN.
    """
    scores = rows_hM.detach().float().cpu()
    return scores.masked_fill(scores.isinf(), torch.nan).nanmean(0).reshape(grid).numpy()


def attention_pictures(photos: list[Picture], maps: np.ndarray) -> list[Picture]:
    """Turn each photo pale grey, and colour its patches more strongly for larger values of its map.

    maps: (V, rows, columns), one map for each photo. All photos share one scale, from the least to
    the greatest value of all maps. Patches with NaN are grey.
    """
    seen = maps[np.isfinite(maps)]
    low = seen.min(initial=np.inf)
    high = seen.max(initial=-np.inf)
    # one scale for all photos: a query may read one of them alone
    shades = (maps - low) / max(high - low, 1e-12)
    pictures = []
    for photo, shade in zip(photos, shades, strict=True):
        # nearest: patches stay squares, and NaN stays NaN
        size = photo.shape[1::-1]
        cells = Image.fromarray(shade.astype(np.float32)).resize(size, Image.Resampling.NEAREST)
        opaque = 0.9 * np.asarray(cells)[..., None]
        mixed = opaque * np.array(ATTENTION_COLOR) + (1 - opaque) * washed(photo, 0.4)
        mixed = np.where(np.isnan(opaque), NOTHING, mixed)
        pictures.append(mixed.round().astype(np.uint8))
    return pictures


@dataclass(frozen=True)
class DrawnQuery:
    """A query in a figure.

    index: number of the query. color: RGB. dispersion: mean distance of the query's Gaussians from
    their centroid, in world units.
    """

    index: int
    color: Color
    dispersion: float


def colored_queries(gaussians: Gaussians, count: int, chosen: Sequence[int]) -> list[DrawnQuery]:
    """Return a DrawnQuery for each index in `chosen`; the nth index gets the nth colour.

    gaussians: (B, G); only the first scene is used. count: number of all queries of a scene.
    """
    distances = token_dispersion(gaussians.means.detach(), gaussians.count // count)[0]
    mean = distances.view(count, -1).mean(1)
    return [DrawnQuery(q, categorical(place), float(mean[q])) for place, q in enumerate(chosen)]


def rendered_weights(model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return the blending weight (B, G) of each Gaussian, summed over pixels and views.

    cameras: the views to render, (B, V).
    """
    # it is the gradient of a render's sum by the colours
    colors = gaussians.colors.detach().requires_grad_()
    with torch.enable_grad():
        painted = gaussians.replace(colors=colors, sh=None, features=None)
        rgb = model.render(painted, cameras).rgb
        (gradient,) = torch.autograd.grad(rgb.sum(), colors)
    return gradient.mean(-1)


def notable_queries(
    model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras, count: int
) -> list[DrawnQuery]:
    """Choose `count` queries to show in the first of V cameras (1, V).

    Preferred are queries with large blending weights whose Gaussians lie, on average, away from the
    border of the picture and away from queries chosen before. Queries with a Gaussian wider than
    half the picture (4 sigma) are chosen only if there are too few other queries.
    """
    per_query = model.head.gaussians_per_query
    weights_NK = rendered_weights(model, gaussians, cameras)[0].cpu().unflatten(0, (-1, per_query))
    means_NK3 = gaussians.means[0].cpu().view(*weights_NK.shape, 3)
    weights_N = weights_NK.sum(1)
    seen_N3 = (means_NK3 * weights_NK[..., None]).sum(1) / weights_N[:, None].clamp_min(1e-12)
    places_N2 = _pixels(seen_N3.to(gaussians.means), cameras) / torch.tensor(cameras.size[::-1])
    outside_N = ((places_N2 - 0.5).abs() >= 0.5 - MARGIN).any(1)
    depths = to_camera(gaussians.means[:1], cameras)[0, 0, :, 2]
    focal = cameras.intrinsics[0, 0, :2].mean()
    pixels = 4 * gaussians.scales[0].amax(-1) * focal / depths.clamp_min(1e-3)
    wide = (depths > 0) & (pixels >= 0.5 * max(cameras.size))
    wide_N = wide.view_as(weights_NK).any(1).cpu()
    faults_N = (2 * outside_N + wide_N).tolist()
    order = sorted(weights_N.argsort(descending=True).tolist(), key=faults_N.__getitem__)
    chosen = list[int]()
    # those that are apart first, then any
    for least in (0.6 / count**0.5, 0.0):
        for n in order:
            if len(chosen) == count:
                break
            far = all((places_N2[n] - places_N2[other]).norm() >= least for other in chosen)
            if far and n not in chosen:
                chosen.append(n)
    return colored_queries(gaussians, len(weights_N), chosen)


def query_picture(
    model: QueryGaussianModel, gaussians: Gaussians, chosen: Sequence[DrawnQuery], cameras: Cameras
) -> Picture:
    """Draw the Gaussians of the queries `chosen` in colour over the scene in grey.

    Lines lead from each coloured Gaussian to the centroid of the Gaussians of its query.
    """
    scene = washed(rgb_picture(model.render(gaussians, cameras).rgb[0, 0]))
    per_query = model.head.gaussians_per_query
    members = [query.index * per_query + k for query in chosen for k in range(per_query)]
    shown = gaussians[:, members]
    paint = torch.tensor([q.color for q in chosen]).view(-1, 3).to(shown.colors) / 255
    colors = paint.repeat_interleave(per_query, 0)[None]
    # a query whose Gaussians are nearly clear is still seen
    opacities = shown.opacities.clamp_min(0.5)
    visible = shown.replace(colors=colors, opacities=opacities, sh=None, features=None)
    # over black, so that its colour and alpha can be mixed with the scene
    painted = model.render(visible, cameras, torch.zeros(3))
    alpha = painted.alpha[0, 0, 0].cpu().numpy()[..., None]
    color = painted.rgb[0, 0].permute(1, 2, 0).cpu().numpy() * 255
    picture = (scene * (1 - alpha) + color).clip(0, 255).round().astype(np.uint8)
    image = ImageOps.scale(Image.fromarray(picture), OVERSAMPLING)
    draw = ImageDraw.Draw(image, "RGBA")
    for query, means in zip(chosen, shown.means[0].split(per_query), strict=False):
        front = to_camera(means[None], cameras)[0, 0, :, 2] > 1e-3
        points = torch.cat([means.mean(0, keepdim=True), means[front]])
        hub, *rays = (_pixels(points, cameras) * OVERSAMPLING).tolist()
        for end in rays:
            draw.line([*hub, *end], fill=(*query.color, 200), width=OVERSAMPLING)
            draw.circle(end, 1.6 * OVERSAMPLING, fill=(*query.color, 255), outline=(*INK, 160))
    return _reduced(image)


def attention_pictures_of(
    scene: QueryScene, query: int, layer: int, side: int
) -> dict[str, list[Picture]]:
    """Return the input photos, coloured by what a query attends to (mean over heads).

    The result has a list of pictures for each key of PARTS: content logits, geometry bias, and the
    attention that results from both. A part that the model does not have is missing; without
    attention the result is empty. layer: number of the decoder layer, from 1. side: pixels on the
    longer side of each picture.
    """
    found = scene.attention(query, layer)
    if found is None or scene.views is None:
        return {}
    photos = [enlarged(rgb_picture(image), side) for image in scene.views.images[0]]
    return {
        part: attention_pictures(photos, patch_maps(value[0, :, 0], scene.grid))
        for part, value in vars(found).items()
        if value is not None
    }


def sheet(pictures: list[Picture]) -> Picture:
    """Join pictures of one size into a single picture with two in each row."""
    # the last row may lack one
    padded = [*pictures, np.full_like(pictures[0], 255)]
    rows = [side_by_side(padded[first : first + 2]) for first in range(0, len(pictures), 2)]
    return np.concatenate(rows)
