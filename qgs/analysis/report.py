"""report.html: what was trained and how it compares, in one self-contained page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image
from torch import Tensor

from qgs.analysis.reconstruction import orbit_path
from qgs.analysis.trace import trace
from qgs.contracts import Column
from qgs.data.sampling import Sample
from qgs.drawing.figures import Curves, curves_figure, figure_picture, hex_color
from qgs.drawing.images import (
    Picture,
    depth_picture,
    depth_range,
    enlarged,
    finer,
    png_bytes,
    rgb_picture,
    side_by_side,
)
from qgs.drawing.queries import (
    Token,
    attention_pictures,
    notable_tokens,
    patch_maps,
    support_picture,
    token_picture,
)
from qgs.metrics import psnr
from qgs.model import QueryGaussianModel
from qgs.types import Prediction, Rendering


@dataclass(frozen=True)
class Contender:
    """A trained model and its figures.

    scores: means over unseen scenes of `Report.columns`. gaussians: per scene. seconds: of
    training. recipe: the resolved recipe as YAML.
    """

    name: str
    model: QueryGaussianModel
    scores: Mapping[str, float | None]
    gaussians: int
    parameters: int
    seconds: float
    curves: Curves
    recipe: str


@dataclass(frozen=True)
class Baseline:
    """What needs no model: its `Report.columns` on the same views."""

    name: str
    scores: Mapping[str, float | None]


@dataclass(frozen=True)
class Report:
    """A comparison.

    columns: name of each score to how it is shown. contenders: in the order in which they are
    shown. samples: the unseen scenes to picture. depths: for each of them the true depth
    (T, 1, H, W) of its targets in the model's units, where known. facts: name to value, what was
    run where.
    """

    columns: Mapping[str, Column]
    title: str
    contenders: Sequence[Contender]
    baselines: Sequence[Baseline]
    samples: Sequence[Sample]
    depths: Sequence[Tensor | None]
    facts: Mapping[str, str]


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


@torch.no_grad()
def report_html(report: Report) -> str:
    """The whole page; it needs no other file and no network."""
    environment = Environment(
        loader=PackageLoader("qgs.analysis", "template"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(png=png_uri, animation=animation_uri, hex=hex_color)
    return environment.get_template("report.html").render(_contents(report))


def _contents(report: Report) -> dict[str, Any]:
    first = report.samples[0]
    predictions = [
        [(c.name, c.model, c.model(sample.inputs)) for c in report.contenders]
        for sample in report.samples
    ]
    of_first = {name: prediction for name, _, prediction in predictions[0]}
    curves = {contender.name: contender.curves for contender in report.contenders}
    return {
        "report": report,
        "scenes": [
            scene_gallery(sample, of_sample, depth)
            for sample, of_sample, depth in zip(
                report.samples, predictions, report.depths, strict=True
            )
        ],
        "tokens": [token_gallery(c, of_first[c.name], first) for c in report.contenders],
        "anchors": {c.name: anchor_tiles(c, first) for c in report.contenders},
        "attention": {
            c.name: attention_tiles(c, of_first[c.name], first) for c in report.contenders
        },
        "orbits": {c.name: orbit_frames(c, of_first[c.name], first) for c in report.contenders},
        "curves": figure_picture(curves_figure(curves), dpi=144),
    }


def png_uri(picture: Picture) -> str:
    """A picture as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(picture)).decode()


def animation_uri(frames: list[Picture], milliseconds: int = 90) -> str:
    """Frames as an endless animated WebP data URI."""
    buffer = BytesIO()
    first, *rest = [Image.fromarray(frame) for frame in frames]
    first.save(
        buffer,
        format="WEBP",
        save_all=True,
        append_images=rest,
        duration=milliseconds,
        loop=0,
        quality=80,
        method=2,
    )
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
