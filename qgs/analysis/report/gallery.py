"""The pictures of a report, gathered model by model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from qgs.analysis.pictures.anchors import support_picture
from qgs.analysis.pictures.attention import attention_pictures, patch_maps
from qgs.analysis.pictures.images import enlarged, finer
from qgs.analysis.pictures.tokens import Token, notable_tokens, token_picture
from qgs.analysis.reconstruction import orbit_path
from qgs.analysis.report.contents import Contender
from qgs.analysis.trace import trace
from qgs.data.sampling import Sample
from qgs.io.drawing import Picture, depth_picture, depth_range, rgb_picture, side_by_side
from qgs.metrics import psnr
from qgs.model import QueryGaussianModel
from qgs.types import Prediction, Rendering

SIDE = 256
"""Pixels on the longer side of pictures that models render for show."""

TOKENS = 5
ANCHORS = 12
ORBIT_FRAMES = 32


@dataclass(frozen=True)
class Tile:
    """A picture and its caption."""

    picture: Picture
    caption: str


@dataclass(frozen=True)
class SceneGallery:
    """One unseen scene: the inputs, and for each target view what `columns` say."""

    name: str
    inputs: list[Tile]
    columns: list[str]
    rows: list[list[Tile]]


@dataclass(frozen=True)
class TokenGallery:
    """Single tokens of one model in one view, and what stands out about each."""

    name: str
    picture: Picture
    tokens: list[Token]


def scene_gallery(
    sample: Sample,
    predictions: Sequence[tuple[str, QueryGaussianModel, Prediction]],
    depth: torch.Tensor | None = None,
    targets: int = 2,
) -> SceneGallery:
    """Renders and depth beside truth for the first `targets` target views.

    depth: the true one (T, 1, H, W), where it is known.
    """
    shown = sample.targets.select(slice(targets))
    renderings = [model.render(p.gaussians, shown.cameras) for _, model, p in predictions]
    names = [name for name, _, _ in predictions]
    depths = {f"{n}, depth": r.depth[0] for n, r in zip(names, renderings, strict=True)}
    if depth is not None:
        depths = {"Truth, depth": depth[:targets]} | depths
    near, far = depth_range(torch.cat(list(depths.values())))
    columns = [_photo_tiles(shown.images[0], sample.target_frames)]
    columns += [_render_tiles(rendering, shown.images[0]) for rendering in renderings]
    columns += [
        [Tile(depth_picture(depth, near, far), "") for depth in column]
        for column in depths.values()
    ]
    return SceneGallery(
        name=sample.scene,
        inputs=_photo_tiles(sample.inputs.images[0], sample.input_frames),
        columns=["Truth", *names, *depths],
        rows=[list(row) for row in zip(*columns, strict=True)],
    )


def _photo_tiles(images: torch.Tensor, frames: Sequence[int]) -> list[Tile]:
    return [
        Tile(rgb_picture(image), f"frame {frame}")
        for image, frame in zip(images, frames, strict=False)
    ]


def _render_tiles(rendering: Rendering, truth: torch.Tensor) -> list[Tile]:
    return [
        Tile(rgb_picture(image), f"{float(psnr(image, target)):.1f} dB")
        for image, target in zip(rendering.rgb[0], truth, strict=True)
    ]


def token_gallery(contender: Contender, prediction: Prediction, sample: Sample) -> TokenGallery:
    """The most notable tokens of a model, seen from the first target view."""
    cameras = finer(sample.targets.cameras[:, :1], SIDE)
    tokens = notable_tokens(contender.model, prediction.gaussians, cameras, TOKENS)
    picture = token_picture(contender.model, prediction.gaussians, tokens, cameras)
    return TokenGallery(contender.name, picture, tokens)


def anchor_tiles(contender: Contender, sample: Sample) -> list[Tile]:
    """Supports on the first input view, before the decoder and after each layer.

    Empty for queries without a place in space.
    """
    model = contender.model
    start = model.queries(1)
    if model.queries.support(start) is None:
        return []
    prediction = model(sample.inputs, layers=range(1, model.depth + 1))
    camera = sample.inputs.cameras[:, :1]
    tokens = notable_tokens(model, prediction.gaussians, camera, ANCHORS)
    colors = {token.query: token.color for token in tokens}
    photo = enlarged(rgb_picture(sample.inputs.images[0, 0]), SIDE, smooth=True)
    states = {"learned start": start} | {
        f"after layer {number}": layer.state for number, layer in prediction.layers.items()
    }
    tiles = []
    for caption, state in states.items():
        support = model.queries.support(state)
        assert support is not None
        tiles.append(Tile(support_picture(photo, support, camera, colors), caption))
    return tiles


def attention_tiles(contender: Contender, prediction: Prediction, sample: Sample) -> list[Tile]:
    """Where the heaviest token looks in the input views: content, geometry, both; mean of heads."""
    model = contender.model
    token = notable_tokens(model, prediction.gaussians, sample.targets.cameras[:, :1], 1)[0]
    with trace(model, layers=[model.depth], queries=[token.query]) as record:
        model(sample.inputs)
    weights = record.layers[model.depth].cross_attention
    if weights is None or record.grid is None:
        return []
    parts = {"content logits": weights.content, "geometry bias": weights.geometry}
    parts["attention"] = weights.weights
    photos = [
        enlarged(rgb_picture(image), SIDE // 2, smooth=True) for image in sample.inputs.images[0]
    ]
    tiles = []
    for caption, part in parts.items():
        if part is not None:
            maps = patch_maps(part[0, :, 0].mean(0), record.grid)
            tiles.append(Tile(side_by_side(attention_pictures(photos, maps)), caption))
    return tiles


def orbit_frames(contender: Contender, prediction: Prediction, sample: Sample) -> list[Picture]:
    """A loop past the input cameras, around what they see."""
    model, cameras = contender.model, sample.inputs.cameras
    depths = model.render(prediction.gaussians, cameras).depth
    path = orbit_path(cameras, depths, ORBIT_FRAMES, SIDE)
    return [rgb_picture(image) for image in model.render(prediction.gaussians, path).rgb[0]]
