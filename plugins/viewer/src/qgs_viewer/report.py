"""report.html: what was trained and how it compares, in one self-contained page."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from importlib.resources import files
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from qgs.contracts import Column, LearnedQueries
from qgs.data.samples import Sample
from qgs.drawing import images, page_environment
from qgs.drawing.figures import figure_picture, hex_color
from qgs.drawing.images import Picture, depth_picture, depth_range, rgb_picture
from qgs.geometry.poses import largest_distance
from qgs.metrics.images import Psnr, psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.saving import orbit_path
from qgs.types import Prediction
from qgs.wording import listed, warn_once
from qgs_viewer.curves import Curves, curves_figure
from qgs_viewer.figures.exhibits import Exhibit, exhibit
from qgs_viewer.pictures import PARTS, attention_pictures_of, color_error, error_picture
from qgs_viewer.queries import DrawnQuery, notable_queries, query_picture


@dataclass(frozen=True)
class Contender:
    """A trained model. scores: means of `Report.columns`. recipe: YAML. about: its kind.

    samples: those of the report in the scale that was found for it; () where it is the same.
    """

    name: str
    model: QueryGaussianModel
    scores: Mapping[str, float | None]
    gaussians: int
    parameters: int
    recipe: str
    about: str = ""
    curves: Curves | None = None
    samples: Sequence[Sample] = ()


@dataclass(frozen=True)
class Report:
    """A comparison of `contenders`, in order, by `columns`: each score and how it is shown.

    baselines: name to scores on the same views. samples: the pictured scenes, headed `scenes`, with
    the true depth of targets where known. lede: a sentence or two below the title. notes: remarks
    below the table. meanings: of the columns. commands: next commands, with what each does.
    """

    columns: Mapping[str, Column]
    title: str
    contenders: Sequence[Contender]
    baselines: Mapping[str, Mapping[str, float | None]]
    samples: Sequence[Sample]
    facts: Mapping[str, str]
    lede: str = ""
    scenes: str = "Unseen scenes"
    notes: Sequence[str] = ()
    meanings: Sequence[str] = ()
    commands: Mapping[str, str] = field(default_factory=dict)


GROUP = "qgs.report"  # entry points NAME = "module:function": like `orbit`, or a generator
SIDE = 256  # pixels on the longer side of pictures that models render for show
QUERIES = 5
ANCHORS = 12
ORBIT_FRAMES = 32
TARGETS = 2  # target views of each scene that are shown
Shown = Sequence[tuple[Contender, Sequence[Prediction]]]
"""Every contender with what it predicts for each of the report's samples."""


@dataclass(frozen=True)
class Tile:
    """A picture, or the frames of an animation. legend: queries in it, in their colours.

    page: HTML without network that a reader can open in its place, in a frame without access to
    the report, dark where `prefers-color-scheme` is. Raises ValueError.
    """

    image: Picture | list[Picture]
    caption: str = ""
    legend: Sequence[DrawnQuery] = ()
    page: str = ""

    def __post_init__(self) -> None:
        for picture in self.image if isinstance(self.image, list) else [self.image]:
            images.checked(picture)


@dataclass(frozen=True)
class ReportSection:
    """A heading, a text, and tiles by model, `width` CSS pixels wide or more. Raises TypeError."""

    title: str
    text: str
    figures: Mapping[str, Sequence[Tile]]
    width: int = 300

    def __post_init__(self) -> None:
        tiles = [tile for tiles in self.figures.values() for tile in tiles]
        if not all(isinstance(tile, Tile) for tile in tiles):
            raise TypeError("its figures must be Tiles")


@torch.no_grad()
def report_html(report: Report) -> str:
    """The whole page; it needs no other file and no network."""
    samples = report.samples
    shown = [(c, [c.model(s.inputs) for s in samples_of(c, samples)]) for c in report.contenders]
    exhibits = [
        exhibit(c.name, c.model, samples_of(c, samples)[0], c.curves) for c in report.contenders
    ]
    sections = [
        *(orbit(shown, samples), *offered_sections(shown, samples), queries(shown, samples)),
        *(anchors(exhibits), attention(exhibits), training_curves(exhibits)),
    ]
    scenes = [
        pictured_scene(
            [(c, predictions[number], samples_of(c, samples)[number]) for c, predictions in shown],
            sample,
        )
        for number, sample in enumerate(samples)
    ]
    environment = page_environment("qgs_viewer", uri=images.data_uri, hex=hex_color)
    template = environment.get_template("report.html")
    sections = [section for section in sections if section.figures]
    return template.render(report=report, scenes=scenes, sections=sections)


def samples_of(contender: Contender, samples: Sequence[Sample]) -> Sequence[Sample]:
    """`samples` of a report in the scale in which this model sees them."""
    return contender.samples or samples


def offered_sections(shown: Shown, samples: Sequence[Sample]) -> Iterator[ReportSection]:
    """Sections of installed distributions by name; those that fail are left out with a warning."""
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            made = entry.load()(shown, samples)
            for section in made if isinstance(made, Iterator | list | tuple) else [made]:
                if not isinstance(section, ReportSection):
                    raise TypeError(f"it gives {type(section).__name__}, not a ReportSection")
                yield section
        except (Exception, SystemExit) as error:
            release = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "no distribution"
            warn_once(
                f"the report does without the section `{entry.name}` of {release}, `{entry.value}`"
                f" fails: {type(error).__name__}: {error}; update {release}, or uninstall it"
            )


def pictured_scene(
    shown: Sequence[tuple[Contender, Prediction, Sample]], sample: Sample
) -> dict[str, Any]:
    """Name, inputs and pictures of a scene by kind and column; `most`: the brightest error.

    shown: each with the sample in its own scale.
    """
    views = sample.targets.select(slice(TARGETS))
    inputs, truth = sample.input_frames, views.images[0]
    frames = [f"frame {sample.label(f)}" for f in (*inputs, *sample.target_frames)]
    colors = {"Truth": _photos(truth, frames[len(inputs) :])}
    depths = {} if views.depths is None else {"Truth": views.depths[0]}
    errors = {}
    for contender, prediction, own in shown:
        cameras = own.targets.select(slice(TARGETS)).cameras
        rendering = contender.model.render(prediction.gaussians, cameras)
        scores = psnr(rendering.rgb[0], truth).tolist()
        quality = [f"{Psnr.column.shown(score)} {Psnr.column.unit}" for score in scores]
        colors[contender.name] = _photos(rendering.rgb[0], quality)
        errors[contender.name] = color_error(rendering.rgb[0], truth)
        depths[contender.name] = rendering.depth[0] * ratio(sample, own)
    near, far = depth_range(torch.cat(list(depths.values())))
    most = depth_range(torch.cat(list(errors.values())))[1]
    kinds = {
        "Render": colors,
        "Error": {n: [Tile(error_picture(e, most)) for e in maps] for n, maps in errors.items()},
        "Depth": {n: [Tile(depth_picture(d, near, far)) for d in m] for n, m in depths.items()},
    }
    numbers = listed(sorted(inputs))
    return {
        "name": sample.scene,
        "frames": f"input frame{'s' if len(inputs) > 1 else ''} {numbers}",
        "inputs": _photos(sample.inputs.images[0], frames[: len(inputs)]),
        "kinds": kinds,
        "most": most,
    }


def ratio(sample: Sample, own: Sample) -> float:
    """Length in the world of `sample` of what has length 1 in that of `own`, of the same views."""
    far, other = (
        float(largest_distance(torch.cat([s.inputs.cameras.c2w, s.targets.cameras.c2w], 1)))
        for s in (sample, own)
    )
    return far / other if other else 1.0


def _photos(images: Tensor, captions: Sequence[str]) -> list[Tile]:
    return [Tile(rgb_picture(i), caption) for i, caption in zip(images, captions, strict=False)]


def orbit(shown: Shown, samples: Sequence[Sample]) -> ReportSection:
    """A loop past the input cameras, around what they see."""
    figures = []
    for contender, (prediction, *_) in shown:
        cameras = samples_of(contender, samples)[0].inputs.cameras
        render = contender.model.render
        depths = render(prediction.gaussians, cameras).depth
        path = orbit_path(cameras, depths, ORBIT_FRAMES, SIDE)
        frames = [rgb_picture(image) for image in render(prediction.gaussians, path).rgb[0]]
        figures.append(Tile(frames, contender.name))
    return titled("orbit", {"": figures})


def queries(shown: Shown, samples: Sequence[Sample]) -> ReportSection:
    """The most notable queries of each model, seen from the first target view."""
    figures = []
    for contender, (prediction, *_) in shown:
        cameras = samples_of(contender, samples)[0].targets.cameras[:, :1]
        cameras = images.finer(cameras, SIDE)
        chosen = notable_queries(contender.model, prediction.gaussians, cameras, QUERIES)
        picture = query_picture(contender.model, prediction.gaussians, chosen, cameras)
        figures.append(Tile(picture, contender.name, chosen))
    return titled("queries", {"": figures})


def anchors(exhibits: Sequence[Exhibit]) -> ReportSection:
    """Supports on the first input view, before the decoder and after each layer."""
    figures: dict[str, list[Tile]] = {}
    for shown in exhibits:
        if shown.look.support(0) is None:
            continue
        chosen = shown.notable(ANCHORS, shown.sample.inputs.cameras[:, :1])
        learned = isinstance(shown.model.queries, LearnedQueries)
        layers = range(shown.look.depth + 1)
        captions = ["learned start" if learned else "start of these photos"]
        captions += [f"after layer {layer}" for layer in layers[1:]]
        tiles = map(Tile, shown.anchors(layers, chosen, SIDE), captions)
        figures[shown.name] = [*tiles]
    return titled("anchors", figures, width=180)


def attention(exhibits: Sequence[Exhibit]) -> ReportSection:
    """Where the heaviest query looks in the input views: content, geometry, both; mean of heads."""
    figures: dict[str, list[Tile]] = {}
    for shown in exhibits:
        (drawn,) = shown.notable(1, shown.sample.targets.cameras[:, :1])
        parts = attention_pictures_of(shown.look, drawn.index, shown.look.depth, SIDE // 2)
        if parts:
            figures[shown.name] = [
                Tile(images.side_by_side(parts[part]), PARTS[part])
                for part in ("content", "geometry", "result")
                if part in parts
            ]
    return titled("attention", figures, width=240)


def training_curves(exhibits: Sequence[Exhibit]) -> ReportSection:
    """Loss and PSNR for every model whose training has a history."""
    curves = {shown.name: shown.curves for shown in exhibits if shown.curves}
    return drawn_section("training", curves_figure(curves) if curves else None)


def titled(
    name: str, figures: Mapping[str, Sequence[Tile]], width: int = 300, **numbers: int
) -> ReportSection:
    """A section with its title and text in template/sections.toml, `numbers` filled in."""
    file = files("qgs_viewer") / "template" / "sections.toml"
    words = tomllib.loads(file.read_text(encoding="utf-8"))[name]
    return ReportSection(words["title"], words["text"].format(**numbers), figures, width)


def drawn_section(name: str, figure: Figure | None, **numbers: int) -> ReportSection:
    """A section of one figure; without one it is left out of the report."""
    tiles = [Tile(figure_picture(figure, dpi=144))] if figure else []
    return titled(name, {"": tiles} if tiles else {}, 600, **numbers)
