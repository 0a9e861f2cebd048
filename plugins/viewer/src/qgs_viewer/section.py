"""Sections of report.html: the scene to turn, refinement, self-attention, dispersion by scene."""

from collections.abc import Iterator, Sequence

import torch

from qgs.data.sampling import Sample
from qgs.drawing.images import rgb_picture, side_by_side
from qgs.geometry.poses import look_at
from qgs.types import Cameras
from qgs_viewer.choice import Choice
from qgs_viewer.figures import anchors, attention, dispersion
from qgs_viewer.figures.exhibits import Exhibit, exhibit
from qgs_viewer.look import Look
from qgs_viewer.page import scenes_html, shared_start
from qgs_viewer.report import ReportSection, Shown, Tile, drawn_section
from qgs_viewer.server import FIELD_OF_VIEW, first_eye, up_of

_SIZE = 240, 320  # of each scene's picture, H, W


def sections(shown: Shown, samples: Sequence[Sample]) -> Iterator[ReportSection]:
    """All of them, of one look at what every model makes of the first of `samples`."""
    exhibits = [exhibit(contender.name, contender.model, samples[0]) for contender, _ in shown]
    yield scene_section(exhibits)
    yield refinement_section(exhibits)
    yield self_attention_section(exhibits)
    yield dispersion_section(shown, samples)


def scene_section(exhibits: Sequence[Exhibit]) -> ReportSection:
    """What every model makes of the scene, side by side, as it can be turned."""
    looks = {shown.name: shown.look for shown in exhibits}
    camera = _first_camera(shared_start(looks.values()))
    with torch.no_grad():
        views = [shown.model.render(shown.gaussians, camera).rgb[0, 0] for shown in exhibits]
    choices = {
        shown.name: Choice(
            query=shown.notable(1, camera)[0].index, layer=shown.look.depth, others="shown"
        )
        for shown in exhibits
        if shown.look.support(0) is not None
    }
    pictures = side_by_side([rgb_picture(view) for view in views])
    tile = Tile(pictures, ", ".join(looks), page=scenes_html(looks, choices))
    return ReportSection(
        "The scene, to turn",
        "The Gaussians of the first scene above in 3D, with the input photos where they were "
        "taken. Where a model has anchors, dots are those of the last layer, and one query is "
        "drawn in full: its support (the ball or ellipsoid around its anchor), the way of its "
        "anchor through the layers as a dark line, and lines to the patches that it reads most. "
        "Drag to turn, scroll to come closer; W, A, S, D, Q and E walk. To pick other queries, see "
        "the scene with the command qgs view, such as qgs view rooms/locus-64.",
        {"": [tile]},
        width=600,
    )


def refinement_section(exhibits: Sequence[Exhibit]) -> ReportSection:
    """Ways, radii and steps of the anchors from layer to layer, of models that have anchors."""
    anchored = [shown for shown in exhibits if shown.look.support(0) is not None]
    return drawn_section(
        "How layers move and size anchors",
        "The first scene from above, with the way of every anchor from its learned start (circle) "
        "to the last layer (dot); then the radius of their supports, and how far each layer moves "
        "the anchors: the line is the median over queries, bands hold half and 90 % of them.",
        anchors.refinement_figure(anchored) if anchored else None,
    )


def self_attention_section(exhibits: Sequence[Exhibit]) -> ReportSection:
    """Self-attention of some queries as a graph, first and last layer, of models that tell it."""
    attending, chosen = attention.self_attending(exhibits)
    return drawn_section(
        "Which queries read which: self-attention",
        f"Queries read not only the photos but, by self-attention, each other. The first scene "
        f"from above, input cameras as triangles. Every dark dot is a query: its anchor before the "
        f"layer, or where it has none, the place of what it adds to the photos. Lines lead from "
        f"{attention.QUERIES} of them to the {attention.EDGES} that each attends to most.",
        attention.self_attention_figure(attending, chosen) if attending else None,
    )


def dispersion_section(shown: Shown, samples: Sequence[Sample]) -> ReportSection:
    """Bars for every scene of the report, where there are several: one says what the table does."""
    found = {
        contender.name: dispersion.dispersions(
            [prediction.gaussians for prediction in predictions],
            contender.model.head.gaussians_per_query,
        )
        for contender, predictions in shown
    }
    labels = dispersion.scene_labels(samples)
    return drawn_section(
        "How far the Gaussians of a query scatter: dispersion",
        "The distance of Gaussians to the centroid of those of their query, in every scene above: "
        "its mean, which a few far Gaussians rule, and its median, in units of the models’ world; "
        "dashed the mean over these scenes. Small where a query stands for one place. Where the "
        "values lie far apart the scale is logarithmic: then the ends of bars count, not their "
        "lengths.",
        dispersion.figure(found, labels) if len(samples) > 1 else None,
    )


def _first_camera(look: Look) -> Cameras:
    """The viewer's first view of a look that is placed in the model's world, (1, 1)."""
    eye, target = (torch.from_numpy(point).double() for point in first_eye(look))
    pose = look_at(eye, target - eye, -up_of(look))
    height, width = _SIZE
    focal = height / 2 / torch.tan(torch.tensor(FIELD_OF_VIEW / 2)).item()
    lens = torch.tensor([focal, focal, width / 2, height / 2])
    return Cameras(pose[None, None].float(), lens[None, None], _SIZE)
