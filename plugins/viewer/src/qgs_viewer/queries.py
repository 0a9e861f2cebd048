"""Queries drawn onto photos: their supports, what they attend to, their Gaussians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from qgs.drawing.figures import INK, Color, categorical
from qgs.drawing.images import NOTHING, Picture, enlarged, rgb_picture
from qgs.geometry.precision import full_precision
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.metrics.dispersion import token_dispersion
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians, SpatialSupport

ATTENTION_COLOR = categorical(0)
OVERSAMPLING = 3
MARGIN = 0.15  # of a picture along its border, where no query is chosen to be shown
OUTLINE_POINTS = 96


@dataclass(frozen=True)
class Ellipses:
    """Outlines in one image, pixels: centers (N, 2), semi-axes as columns of axes (N, 2, 2).

    Only rows where `whole` (all in front of the camera) are ellipses. points: (N, 2), the
    ellipsoids' own centres at camera-frame z `depths` (N,); only positive depths mean something.
    """

    centers: Tensor
    axes: Tensor
    points: Tensor
    depths: Tensor
    whole: Tensor

    def outline(self, index: int) -> Tensor:
        """Points (2, OUTLINE_POINTS) around one ellipse."""
        angle = torch.linspace(0, 2 * torch.pi, OUTLINE_POINTS)
        circle = torch.stack([angle.cos(), angle.sin()])
        return self.centers[index][:, None] + self.axes[index] @ circle


@full_precision
def project_support(support: SpatialSupport, cameras: Cameras) -> Ellipses:
    """Exact perspective outlines of the first scene's ellipsoids in one camera, cameras (1, 1).

    An ellipsoid with centre c and axes A (camera frame) has the dual quadric A A^T - c c^T, whose
    image under K is the dual conic of the outline (Hartley and Zisserman, section 8.3).
    """
    centers_N3 = to_camera(support.centers[:1], cameras)[0, 0]
    axes_N33 = cameras.w2c[0, 0, :3, :3] @ support.axes[0]
    fx, fy, cx, cy = cameras.intrinsics[0, 0]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    calibration = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)
    quadric = axes_N33 @ axes_N33.mT - centers_N3[:, :, None] * centers_N3[:, None, :]
    conic = calibration @ quadric @ calibration.T
    depths, scale = centers_N3[:, 2], -conic[:, 2, 2]
    whole = (scale > 1e-9) & (depths > 0)
    conic = conic / torch.where(whole, scale, 1)[:, None, None]
    centers = -conic[:, :2, 2]
    shape = conic[:, :2, :2] + centers[:, :, None] * centers[:, None, :]
    lengths, directions = torch.linalg.eigh(torch.where(whole[:, None, None], shape, 0))
    axes = directions * lengths.clamp_min(0).sqrt()[:, None, :]
    in_front = torch.where(depths[:, None] > 0, centers_N3, centers_N3.new_tensor([0, 0, 1]))
    points = to_pixels(in_front, cameras.intrinsics[0, 0])
    return Ellipses(centers, axes, points, depths, whole)


def washed(picture: Picture, strength: float = 0.6) -> Picture:
    """Greys, lightened towards white by `strength`: a ground to draw on."""
    grey = picture.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    light = 255 - (255 - grey) * (1 - strength)
    return np.repeat(light[..., None], 3, -1).round().astype(np.uint8)


def _oversampled(picture: Picture) -> Image.Image:
    """An image OVERSAMPLING times as large, to draw smooth lines on; `_reduced` takes it back."""
    return Image.fromarray(enlarged(picture, OVERSAMPLING * max(picture.shape[:2])))


def _reduced(image: Image.Image) -> Picture:
    size = (image.width // OVERSAMPLING, image.height // OVERSAMPLING)
    return np.asarray(image.resize(size, Image.Resampling.LANCZOS))


def support_picture(
    photo: Picture, support: SpatialSupport, cameras: Cameras, colors: Mapping[int, Color]
) -> Picture:
    """All centres as dots, queries of `colors` as ellipses, on the view of cameras (1, 1)."""
    ellipses = project_support(support, cameras)
    scale = OVERSAMPLING * photo.shape[1] / cameras.size[1]
    farthest_first = torch.argsort(ellipses.depths, descending=True).tolist()
    image = _oversampled(washed(photo, 0.45))
    draw = ImageDraw.Draw(image, "RGBA")
    for index in [i for i in farthest_first if i not in colors] + list(colors):
        color = colors.get(index)
        if color and ellipses.whole[index]:
            outline = (ellipses.outline(index) * scale).T.clamp(-1e5, 1e5)
            points = [tuple(point) for point in outline.tolist()]
            draw.polygon(points, fill=(*color, 22))
            draw.line(points, fill=(*color, 255), width=2 * OVERSAMPLING, joint="curve")
        if ellipses.depths[index] > 0:
            center = (ellipses.points[index] * scale).clamp(-1e5, 1e5).tolist()
            size, rim = (4.0, (255, 255, 255, 255)) if color else (1.4, None)
            draw.circle(center, size * OVERSAMPLING, (*(color or INK), 220), rim, OVERSAMPLING)
    return _reduced(image)


def patch_maps(rows_hM: Tensor, grid: tuple[int, int, int]) -> np.ndarray:
    """Scores (h, M) of image tokens as maps (V, H/P, W/P), the mean over heads.

    Heads that a mask keeps from a token (-inf) do not count; NaN where none sees it.
    """
    scores = rows_hM.detach().float().cpu()
    return scores.masked_fill(scores.isinf(), torch.nan).nanmean(0).reshape(grid).numpy()


def attention_pictures(photos: list[Picture], maps: np.ndarray) -> list[Picture]:
    """Each photo in pale grey, coloured by its map on one scale; NaN has the colour of nothing."""
    seen = maps[np.isfinite(maps)]
    low, high = (float(seen.min()), float(seen.max())) if seen.size else (0.0, 1.0)
    hidden = [~np.isfinite(view) for view in maps]
    shades = np.nan_to_num((maps - low) / max(high - low, 1e-12))
    pictures = []
    for photo, shade, unseen in zip(photos, shades, hidden, strict=True):
        size = photo.shape[1::-1]
        patches = Image.fromarray((shade * 255).round().astype(np.uint8))
        cells = np.asarray(patches.resize(size, Image.Resampling.NEAREST))[..., None]
        opaque = 0.9 * cells / 255
        mixed = opaque * np.array(ATTENTION_COLOR) + (1 - opaque) * washed(photo, 0.4)
        mixed[np.asarray(Image.fromarray(unseen).resize(size, Image.Resampling.NEAREST))] = NOTHING
        pictures.append(mixed.round().astype(np.uint8))
    return pictures


@dataclass(frozen=True)
class DrawnQuery:
    """A query by its index. dispersion: mean distance of its Gaussians to their centroid."""

    index: int
    color: Color
    dispersion: float


def colored_queries(gaussians: Gaussians, count: int, chosen: Sequence[int]) -> list[DrawnQuery]:
    """`chosen` of the `count` queries of the first scene, each with a colour by its place."""
    distances = token_dispersion(gaussians.means.detach(), gaussians.count // count)[0]
    mean = distances.view(count, -1).mean(1)
    return [DrawnQuery(q, categorical(place), float(mean[q])) for place, q in enumerate(chosen)]


def rendered_weights(model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Blending weight (B, G) over all pixels: the gradient of a render's sum by the colours."""
    colors = gaussians.colors.detach().clone().requires_grad_()
    with torch.enable_grad():
        rgb = model.render(_painted(gaussians, colors), cameras).rgb
        (gradient,) = torch.autograd.grad(rgb.sum(), colors)
    return gradient.mean(-1)


def _painted(gaussians: Gaussians, colors: Tensor) -> Gaussians:
    """The Gaussians in `colors`, from everywhere."""
    return replace(gaussians, colors=colors, sh=None, features=None)


def notable_queries(
    model: QueryGaussianModel, gaussians: Gaussians, cameras: Cameras, count: int
) -> list[DrawnQuery]:
    """`count` queries to show in cameras (1, V): heavy, well inside the first view, and spread.

    Queries with a Gaussian wider than half the view (2 sigma about its middle) come after others.
    """
    per_query = model.head.gaussians_per_query
    weights_NK = rendered_weights(model, gaussians, cameras)[0].cpu().unflatten(0, (-1, per_query))
    means_NK3 = gaussians.means[0].cpu().view(*weights_NK.shape, 3)
    weights_N = weights_NK.sum(1)
    seen_N3 = (means_NK3 * weights_NK[..., None]).sum(1) / weights_N[:, None].clamp_min(1e-12)
    places_N2 = _pixels(seen_N3.to(gaussians.means), cameras) / torch.tensor(cameras.size[::-1])
    small_N = (_widths(gaussians, cameras).view_as(weights_NK) < 0.5).all(1) & (weights_N > 0)
    chosen = _spread(weights_N.argsort(descending=True).tolist(), places_N2, small_N, count)
    return colored_queries(gaussians, len(weights_N), chosen)


def _widths(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """4 sigma of each Gaussian (G,) as a share of the first view's longer side; 0 behind it."""
    depths = to_camera(gaussians.means[:1], cameras)[0, 0, :, 2]
    focal, side = cameras.intrinsics[0, 0, :2].mean(), max(cameras.size)
    widths = 4 * gaussians.scales[0].amax(-1) * focal / depths.clamp_min(1e-3) / side
    return torch.where(depths > 0, widths, 0).cpu()


def _spread(order: Sequence[int], places_N2: Tensor, small_N: Tensor, count: int) -> list[int]:
    """The first `count` of `order` inside [0, 1]^2 at a distance; others where they are few."""
    inside = [i for i in order if ((places_N2[i] - 0.5).abs() < 0.5 - MARGIN).all()]
    small = [i for i in inside if small_N[i]]
    distance, chosen = 0.6 / count**0.5, list[int]()
    tries = ((small, distance), (inside, distance), (inside, distance / 2), (order, 0.0))
    for candidates, least in tries:
        for i in candidates:
            far = all((places_N2[i] - places_N2[j]).norm() >= least for j in chosen)
            if far and i not in chosen and len(chosen) < count:
                chosen.append(i)
    return chosen


def query_picture(
    model: QueryGaussianModel,
    gaussians: Gaussians,
    chosen: Sequence[DrawnQuery],
    cameras: Cameras,
    background: Tensor | None = None,
) -> Picture:
    """The Gaussians of `chosen` in colour with lines to centroids, over a grey scene; (1, 1)."""
    scene = washed(rgb_picture(model.render(gaussians, cameras, background).rgb[0, 0]))
    per_query = model.head.gaussians_per_query
    members = [range(q.index * per_query, (q.index + 1) * per_query) for q in chosen]
    index = [i for member in members for i in member]
    shown = gaussians[:, torch.tensor(index, dtype=torch.long, device=gaussians.means.device)]
    paint = torch.tensor([q.color for q in chosen]).view(-1, 3).to(shown.colors) / 255
    colors = paint.repeat_interleave(per_query, 0)[None]
    visible = replace(_painted(shown, colors), opacities=shown.opacities.clamp_min(0.5))
    painted = model.render(visible, cameras, torch.zeros(3))
    alpha = painted.alpha[0, 0, 0].cpu().numpy()[..., None]
    color = painted.rgb[0, 0].permute(1, 2, 0).cpu().numpy() * 255
    picture = (scene * (1 - alpha) + color).clip(0, 255).round().astype(np.uint8)
    image = _oversampled(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    for member, query in zip(members, chosen, strict=True):
        means = gaussians.means[0, list(member)]
        front = to_camera(means[None], cameras)[0, 0, :, 2] > 1e-3
        points = torch.cat([means.mean(0, keepdim=True), means[front]])
        pixels = _pixels(points, cameras).clamp(-1e4, 1e4) * OVERSAMPLING
        hub, *rays = [tuple(point) for point in pixels.tolist()]
        for end in rays:
            draw.line([hub, end], fill=(*query.color, 200), width=OVERSAMPLING)
        for end in rays:
            draw.circle(end, 1.6 * OVERSAMPLING, fill=(*query.color, 255), outline=(*INK, 160))
    return _reduced(image)


def _pixels(points: Tensor, cameras: Cameras) -> Tensor:
    """Pixels (P, 2) of world points (P, 3) in the first of cameras (1, V), z floored at 1 mm."""
    in_camera = to_camera(points[None], cameras)[0, 0]
    in_camera = torch.cat([in_camera[:, :2], in_camera[:, 2:].clamp_min(1e-3)], -1)
    return to_pixels(in_camera, cameras.intrinsics[0, 0]).cpu()
