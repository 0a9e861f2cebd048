"""Build the sections of report.html; `qgs figures` draws those that a FigureName names."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import LearnedQueries
from qgs.data.view_samplers import evenly
from qgs.drawing.figures import figure_picture
from qgs.drawing.images import (
    Picture,
    depth_picture,
    depth_range,
    finer,
    rgb_picture,
    shaded,
    side_by_side,
)
from qgs.metrics.images import Psnr, psnr
from qgs_viewer.curves import curves_figure
from qgs_viewer.drawing import Choice
from qgs_viewer.look import enlarged
from qgs_viewer.page import scene_html, template
from qgs_viewer.queries import (
    PARTS,
    DrawnQuery,
    attention_pictures_of,
    query_picture,
    support_picture,
)
from qgs_viewer.scenes import ModelScenes

ERROR_MAP = "inferno"
QUERIES = 5
ANCHORS = 12
# Decoder layers after which anchors are shown.
LAYERS = 3
NOVEL_SCENES = 3
Shown = Sequence[ModelScenes]


@dataclass(frozen=True)
class Tile:
    """A picture of a section, with its caption.

    legend: queries that the picture shows, with their colours. page: a complete HTML page that a
    reader can open in place of the picture; "" for no page. The report shows the page in a frame
    that cannot read the report.
    """

    image: Picture
    caption: str = ""
    legend: Sequence[DrawnQuery] = ()
    page: str = ""


@dataclass(frozen=True)
class Section:
    """A section of the report: pictures in rows.

    name: key of the section's texts in sections.toml. rows: tiles by label of the row; None leaves
    a gap. figure: Matplotlib figure for `qgs figures`; if it is None, the command draws the tiles.
    width: least width of a tile in CSS pixels.
    """

    name: str
    rows: Mapping[str, Sequence[Tile | None]]
    figure: Figure | None = None
    width: int = 300

    @property
    def words(self) -> Mapping[str, str]:
        """Texts of the section: `title`, `text`, and `empty`, which says why it has no pictures."""
        return tomllib.loads(template("sections.toml"))[self.name]


@dataclass(frozen=True)
class Detail:
    """Options of the pictures in a section.

    side: pixels on the longer side of a picture. query: index of the query to show; None chooses
    queries that are well visible.
    """

    side: int = 256
    query: int | None = None


def scene_to_turn(models: Shown) -> Section:
    """Return a section with the first scene of every model, as a picture and as an HTML page.

    The page shows the scene in 3D, where it can be turned.
    """
    tiles = []
    for model in models:
        camera = finer(model.target_camera, Detail.side)
        picture = rgb_picture(model.network.render(model.gaussians[0], camera).rgb[0, 0])
        page = scene_html(model.scene, Choice(anchors=False))
        tiles.append(Tile(picture, model.name, page=page))
    return Section("scene", {"": tiles})


def queries(models: Shown, detail: Detail) -> Section:
    """Return a section with the Gaussians of well visible queries of each model.

    The Gaussians are seen from the first target view.
    """
    tiles = []
    for model in models:
        camera = finer(model.target_camera, detail.side)
        chosen = model.notable(QUERIES, camera, detail.query)
        picture = query_picture(model.network, model.gaussians[0], chosen, camera)
        tiles.append(Tile(picture, model.name, chosen))
    return Section("queries", {"": tiles})


def anchors(models: Shown, detail: Detail) -> Section:
    """Return a section with anchors and support ellipsoids of queries on the first input photo.

    There is one row for each model with anchors. The columns show the anchors before the first
    decoder layer and after some layers.
    """
    rows = {}
    for model in models:
        if model.scene.support(0) is None:
            continue
        # of the first input
        camera = model.samples[0].inputs.cameras[:, :1]
        drawn = model.notable(ANCHORS, camera, detail.query)
        colors = {query.index: query.color for query in drawn}
        photo = enlarged(rgb_picture(model.samples[0].inputs.images[0, 0]), detail.side)
        # others start from the photos, so their start differs by scene
        learned = isinstance(model.network.queries, LearnedQueries)
        layers = range(model.scene.depth + 1)
        tiles = []
        for layer in evenly(layers, LAYERS + 1):
            # supports are float64, the camera that projects them is float32
            support = map_tensors(Tensor.float, model.scene.support(layer))
            picture = support_picture(photo, support, camera.to("cpu"), colors)
            start = "learned start" if learned else "start of these photos"
            tiles.append(Tile(picture, f"after layer {layer}" if layer else start))
        rows[model.name] = tiles
    return Section("anchors", rows, width=180)


def cross_attention(models: Shown, detail: Detail) -> Section:
    """Return a section with the attention of one query of each model to photo patches.

    The columns show logits from content, bias from geometry, and the attention that results from
    both.
    """
    rows = {}
    for model in models:
        (query,) = model.notable(1, model.target_camera, detail.query)
        # half the side: photos stand side by side in one picture
        found = attention_pictures_of(model.scene, query.index, model.scene.depth, detail.side // 2)
        if found:
            rows[f"{model.name}, query {query.index}"] = [
                Tile(side_by_side(found[part]), title) if part in found else None
                for part, title in PARTS.items()
            ]
    return Section("attention", rows, width=240)


def curves(models: Shown, detail: Detail) -> Section:
    """Return a section with loss and PSNR over the training, for models with a history."""
    records = {model.name: model.curves for model in models if model.curves}
    if not records:
        return Section("training", {})
    figure = curves_figure(records)
    tile = Tile(figure_picture(figure, dpi=168))
    return Section("training", {"": [tile]}, figure, width=600)


def novel_views(models: Shown, detail: Detail) -> Section:
    """Return a section with the middle target view of each scene, for at most three scenes.

    Each scene has three rows: renders, errors of the renders, depths. The columns are the inputs,
    the real photos (truth) and the models.
    """
    rows: dict[str, Sequence[Tile | None]] = {}
    for place, sample in enumerate(models[0].samples[:NOVEL_SCENES]):
        scene = pictured_scene(models, place, [len(sample.target_frames) // 2])
        given: list[Tile | None] = scene["inputs"]
        for kind, columns in scene["kinds"].items():
            tiles = [*given]
            for name in ("Truth", *(model.name for model in models)):
                (tile,) = columns.get(name, [None])
                tiles.append(tile and replace(tile, caption=f"{name} {tile.caption}"))
            rows[f"{place + 1}: {sample.scene}, {kind.lower()}"] = tiles
            # inputs stand in the first row of their scene alone
            given = [None] * len(given)
    return Section("novel_views", rows)


def pictured_scene(models: Shown, place: int, targets: Sequence[int]) -> dict[str, Any]:
    """Return the pictures of a scene as a dict for the template.

    Keys are `name`, the name of the scene; `inputs`, tiles of the input photos; `kinds`, tiles of
    the target views by kind (Render, Error, Depth), then by column (Truth, names of models);
    `most`, the absolute error that the error pictures show as the brightest colour; and `views`,
    pairs of the PSNR by the first model and the renders of all, by column, of each target view.

    place: index of the scene among the samples. targets: indices of the target views to show.
    """
    sample = models[0].samples[place]
    views = sample.targets.select(list(targets))
    truth = views.images[0]
    captions = [f"frame {sample.short_label(sample.target_frames[view])}" for view in targets]
    colors = {"Truth": _photos(truth, captions)}
    depths = {} if views.depths is None else {"Truth": views.depths[0]}
    errors = {}
    ranks: list[float] = []
    for model in models:
        own = model.samples[place]
        cameras = own.targets.select(list(targets)).cameras
        rendering = model.network.render(model.gaussians[place], cameras)
        rgb = rendering.rgb[0]
        scores = psnr(rgb, truth).tolist()
        ranks = ranks or scores
        quality = [f"{Psnr.column.shown(score)} {Psnr.column.unit}" for score in scores]
        colors[model.name] = _photos(rgb, quality)
        errors[model.name] = (rgb.clamp(0, 1) - truth.to(rgb)).abs().mean(1, keepdim=True)
        # models may see the scene in worlds of different units
        depths[model.name] = rendering.depth[0] * float(sample.world[1] / own.world[1])
    # one scale for truth and models, or pictures could not be compared
    near, far = depth_range(torch.cat(list(depths.values())))
    most = depth_range(torch.cat(list(errors.values())))[1]
    kinds = {
        "Render": colors,
        "Error": {
            name: [Tile(shaded(error, 0.0, most, ERROR_MAP)) for error in maps]
            for name, maps in errors.items()
        },
        "Depth": {
            name: [Tile(depth_picture(depth, near, far)) for depth in maps]
            for name, maps in depths.items()
        },
    }
    shown = zip(ranks, *colors.values(), strict=True)
    inputs = [f"frame {sample.short_label(frame)}" for frame in sample.input_frames]
    return {
        "name": sample.scene,
        "inputs": _photos(sample.inputs.images[0], inputs),
        "kinds": kinds,
        "most": most,
        "views": [(score, dict(zip(colors, tiles, strict=True))) for score, *tiles in shown],
    }


def _photos(photos: Tensor, captions: Sequence[str]) -> list[Tile]:
    return [
        Tile(rgb_picture(photo), caption) for photo, caption in zip(photos, captions, strict=True)
    ]
