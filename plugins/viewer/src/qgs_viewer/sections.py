"""Sections of report.html, most of which `qgs figures` draws as figures too."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import LearnedQueries
from qgs.data.frames import evenly
from qgs.drawing import images
from qgs.drawing.figures import figure_picture
from qgs.drawing.images import Picture, depth_picture, depth_range, rgb_picture, side_by_side
from qgs.metrics.images import Psnr, psnr
from qgs.reconstruction.saving import orbit_path
from qgs.wording import listed
from qgs_viewer.choice import Choice
from qgs_viewer.curves import curves_figure
from qgs_viewer.page import scenes_html
from qgs_viewer.pictures import PARTS, attention_pictures_of, color_error, error_picture
from qgs_viewer.placement import Placement
from qgs_viewer.queries import DrawnQuery, query_picture, support_picture
from qgs_viewer.scenes import ModelScenes, ratio

QUERIES = 5
ANCHORS = 12
NOVEL_SCENES = 3
ORBIT_FRAMES = 32
Shown = Sequence[ModelScenes]


@dataclass(frozen=True)
class Tile:
    """A picture, or the frames of an animation. legend: queries in it, in their colours.

    page: HTML without network that a reader can open in its place, in a frame without access to
    the report, dark where `prefers-color-scheme` is.
    """

    image: Picture | list[Picture]
    caption: str = ""
    legend: Sequence[DrawnQuery] = ()
    page: str = ""


@dataclass(frozen=True)
class Section:
    """Rows of tiles by label, None for a gap; words are in sections.toml.

    figure: for print, where the tiles are not all of it. width: least CSS pixels of a tile.
    """

    name: str
    rows: Mapping[str, Sequence[Tile | None]] = field(default_factory=dict)
    figure: Figure | None = None
    width: int = 300

    @property
    def words(self) -> Mapping[str, str]:
        """Its `title` and `text`, and what is said where no model has data for it: `empty`."""
        return _words()[self.name]


@cache
def _words() -> Mapping[str, Mapping[str, str]]:
    file = files("qgs_viewer") / "template" / "sections.toml"
    return tomllib.loads(file.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Detail:
    """How sections show models.

    side: pixels on the longer side of pictures. layers: how many are shown; by default anchors
    after all layers and attention in the last. query: the one to show; by default notable ones.
    """

    side: int = 256
    layers: int | None = None
    query: int | None = None


def orbit(models: Shown) -> Section:
    """A loop past the input cameras, around what they see."""
    tiles = []
    for model in models:
        cameras = model.samples[0].inputs.cameras
        gaussians = model.gaussians[0]
        depths = model.network.render(gaussians, cameras).depth
        path = orbit_path(cameras, depths, ORBIT_FRAMES, Detail.side)
        renders = model.network.render(gaussians, path).rgb[0]
        tiles.append(Tile([rgb_picture(image) for image in renders], model.name))
    return Section("orbit", {"": tiles})


def scene_to_turn(models: Shown) -> Section:
    """The first scene as every model makes it, side by side, on a page to turn it."""
    scenes = {}
    pictures = []
    choices = {}
    for model in models:
        # one camera looks at all of them, so they need one scale
        place = replace(Placement.identity(), scale=ratio(models[0].samples[0], model.samples[0]))
        scenes[model.name] = replace(model.scene, placement=place)
        camera = images.finer(model.target_camera, Detail.side)
        pictures.append(rgb_picture(model.network.render(model.gaussians[0], camera).rgb[0, 0]))
        if model.scene.has_anchors:
            (query,) = model.notable(1, camera)
            choices[model.name] = Choice(query.index, layer=model.scene.depth, others="shown")
    tile = Tile(side_by_side(pictures), ", ".join(scenes), page=scenes_html(scenes, choices))
    return Section("scene", {"": [tile]}, width=600)


def queries(models: Shown, detail: Detail) -> Section:
    """The Gaussians of notable queries of each model, seen from the first target view."""
    tiles = []
    for model in models:
        camera = images.finer(model.target_camera, detail.side)
        chosen = model.notable(QUERIES, camera, detail.query)
        picture = query_picture(model.network, model.gaussians[0], chosen, camera)
        tiles.append(Tile(picture, model.name, chosen))
    return Section("queries", {"": tiles})


def anchors(models: Shown, detail: Detail) -> Section:
    """Anchors and supports on the first input view, before the decoder and after its layers."""
    rows = {}
    for model in models:
        if not model.scene.has_anchors:
            continue
        camera = model.input_camera
        drawn = model.notable(ANCHORS, camera, detail.query)
        colors = {query.index: query.color for query in drawn}
        photo = images.enlarged(rgb_picture(model.samples[0].inputs.images[0, 0]), detail.side)
        # others start from the photos, so their start differs by scene
        learned = isinstance(model.network.queries, LearnedQueries)
        layers = range(model.scene.depth + 1)
        tiles = []
        for layer in evenly(layers, len(layers) if detail.layers is None else detail.layers + 1):
            support = map_tensors(Tensor.float, model.scene.support(layer))
            picture = support_picture(photo, support, camera.to("cpu"), colors)
            start = "learned start" if learned else "start of these photos"
            tiles.append(Tile(picture, f"after layer {layer}" if layer else start))
        rows[model.name] = tiles
    return Section("anchors", rows, width=180)


def attention(models: Shown, detail: Detail) -> Section:
    """What one query of each model reads in the input views: content, geometry, both."""
    rows = {}
    for model in models:
        (query,) = model.notable(1, model.target_camera, detail.query)
        depth = model.scene.depth
        layers = [depth] if detail.layers is None else evenly(range(1, depth + 1), detail.layers)
        for layer in layers:
            # half the side: photos stand side by side in one picture
            found = attention_pictures_of(model.scene, query.index, layer, detail.side // 2)
            tiles: list[Tile | None] = []
            for part in ("content", "geometry", "result"):
                seen = part in found
                tiles.append(Tile(side_by_side(found[part]), PARTS[part]) if seen else None)
            if found:
                rows[f"{model.name}, query {query.index}, layer {layer}"] = tiles
    return Section("attention", rows, width=240)


def training_curves(models: Shown, detail: Detail) -> Section:
    """Loss and PSNR of every model whose training has a history."""
    curves = {model.name: model.curves for model in models if model.curves}
    if not curves:
        return Section("training")
    figure = curves_figure(curves)
    tile = Tile(figure_picture(figure, dpi=168))
    return Section("training", {"": [tile]}, figure, width=600)


def novel_views(models: Shown, detail: Detail) -> Section:
    """The middle target of three scenes: inputs, truth, renders, their error and depth."""
    rows: dict[str, Sequence[Tile | None]] = {}
    for place, sample in enumerate(models[0].samples[:NOVEL_SCENES]):
        scene = pictured_scene(models, place, [len(sample.target_frames) // 2])
        kinds = scene["kinds"]
        inputs = scene["inputs"]
        (truth,) = kinds["Render"]["Truth"]
        (depth,) = kinds["Depth"].get("Truth", [None])
        for number, model in enumerate(models):
            # what all models share stands in the rows of the first ones
            tiles = {"input": inputs[number] if number < len(inputs) else None}
            tiles["truth"] = None if number else truth
            tiles["true depth"] = None if number else depth
            for kind, columns in kinds.items():
                (tiles[kind.lower()],) = columns[model.name]
            row = f"{place + 1}: {scene['name']}, {model.name}"
            rows[row] = [_titled(tile, title) for title, tile in tiles.items()]
    return Section("novel_views", rows)


def _titled(tile: Tile | None, title: str) -> Tile | None:
    if tile is None:
        return None
    return replace(tile, caption=f"{title}, {tile.caption}" if tile.caption else title)


def pictured_scene(models: Shown, place: int, targets: Sequence[int]) -> dict[str, Any]:
    """Name, inputs and pictures of a scene by kind and column; `most`: the brightest error.

    targets: places of the target views that are shown.
    """
    sample = models[0].samples[place]
    views = sample.targets.select(list(targets))
    truth = views.images[0]
    captions = [f"frame {sample.label(sample.target_frames[target])}" for target in targets]
    colors = {"Truth": _photos(truth, captions)}
    depths = {}
    if views.depths is not None:
        depths["Truth"] = views.depths[0]
    errors = {}
    for model in models:
        own = model.samples[place]
        cameras = own.targets.select(list(targets)).cameras
        rendering = model.network.render(model.gaussians[place], cameras)
        rgb = rendering.rgb[0]
        scores = psnr(rgb, truth).tolist()
        quality = [f"{Psnr.column.shown(score)} {Psnr.column.unit}" for score in scores]
        colors[model.name] = _photos(rgb, quality)
        errors[model.name] = color_error(rgb, truth)
        # models may see the scene in worlds of different units
        depths[model.name] = rendering.depth[0] * ratio(sample, own)
    # one scale for truth and models, or pictures could not be compared
    near, far = depth_range(torch.cat(list(depths.values())))
    most = depth_range(torch.cat(list(errors.values())))[1]
    kinds: dict[str, dict[str, list[Tile]]] = {"Render": colors, "Error": {}, "Depth": {}}
    for name, maps in errors.items():
        kinds["Error"][name] = [Tile(error_picture(error, most)) for error in maps]
    for name, maps in depths.items():
        kinds["Depth"][name] = [Tile(depth_picture(depth, near, far)) for depth in maps]
    frames = sample.input_frames
    inputs = [f"frame {sample.label(frame)}" for frame in frames]
    return {
        "name": sample.scene,
        "frames": f"input frame{'s' if len(frames) > 1 else ''} {listed(sorted(frames))}",
        "inputs": _photos(sample.inputs.images[0], inputs),
        "kinds": kinds,
        "most": most,
    }


def _photos(photos: Tensor, captions: Sequence[str]) -> list[Tile]:
    pairs = zip(photos, captions, strict=True)
    return [Tile(rgb_picture(photo), caption) for photo, caption in pairs]
