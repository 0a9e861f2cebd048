"""Sections of report.html: the scene to turn, refinement by layer, which queries read which."""

import torch

from qgs.analysis.report import ReportSection, Shown, Tile
from qgs.data.sampling import Sample
from qgs.drawing.figures import figure_picture
from qgs.drawing.images import rgb_picture, side_by_side
from qgs.drawing.queries import notable_queries
from qgs.geometry.poses import look_at
from qgs.types import Cameras
from qgs_viewer.choice import Choice
from qgs_viewer.figures import graph, refinement
from qgs_viewer.figures.exhibits import exhibit
from qgs_viewer.look import Look, look_inside
from qgs_viewer.page import scenes_html, shared_start
from qgs_viewer.server import FIELD_OF_VIEW, first_eye, up_of

_SIZE = 240, 320  # of each scene's picture, H, W


def scene_section(shown: Shown, sample: Sample) -> ReportSection:
    """What every model makes of `sample`, side by side, as it can be turned."""
    labels = [sample.label(frame) for frame in sample.input_frames]
    looks = {
        contender.name: look_inside(contender.model, sample.inputs, labels, sample.input_frames)
        for contender, _ in shown
    }
    camera = _first_camera(shared_start(looks.values()))
    pictures = [
        rgb_picture(contender.model.render(prediction.gaussians, camera).rgb[0, 0])
        for contender, prediction in shown
    ]
    names = ", ".join(looks)
    choices = {
        contender.name: Choice(
            query=notable_queries(contender.model, prediction.gaussians, camera, 1)[0].index,
            layer=contender.model.depth,
            others="shown",
        )
        for contender, prediction in shown
        if looks[contender.name].support(0) is not None
    }
    tile = Tile(side_by_side(pictures), names, page=scenes_html(looks, choices))
    return ReportSection(
        "The scene, to turn",
        "The Gaussians of the first scene above in 3D, with the input photos where they were "
        "taken, and the anchors of the last layer as dots where there are any: of a query that is "
        "notable in the first view of it also the support, its way through the layers as a dark "
        "line, and lines to the patches that it reads most. Drag to turn, scroll to come closer; "
        "W, A, S, D, Q and E walk.",
        {"": [tile]},
        width=600,
    )


def self_attention_section(shown: Shown, sample: Sample) -> ReportSection:
    """Self-attention of some queries as a graph, first and last layer, of models that tell it."""
    exhibits = [exhibit(contender.name, contender.model, sample) for contender, _ in shown]
    told = [e for e in exhibits if e.look.self_attention(0, e.look.depth) is not None]
    view = sample.targets.cameras[:, :1]
    chosen = {e.name: e.notable(graph.QUERIES, view) for e in told}
    tiles = [Tile(figure_picture(graph.figure(told, chosen), dpi=144))] if told else []
    return ReportSection(
        "Which queries read which",
        f"The first scene from above, input cameras as triangles. Every dark dot is a query: its "
        f"anchor before the layer, or where it has none, the place of what it adds to the photos. "
        f"Lines lead from {graph.QUERIES} of them to the {graph.EDGES} that each attends to most.",
        {"": tiles} if tiles else {},
        width=600,
    )


def refinement_section(shown: Shown, sample: Sample) -> ReportSection:
    """Ways, radii and steps of the anchors from layer to layer, of models that have anchors."""
    exhibits = [exhibit(contender.name, contender.model, sample) for contender, _ in shown]
    anchored = [e for e in exhibits if e.look.support(0) is not None]
    tiles = [Tile(figure_picture(refinement.figure(anchored), dpi=144))] if anchored else []
    return ReportSection(
        "How layers move and size anchors",
        "The first scene from above, with the way of every anchor from its learned start (circle) "
        "to the last layer (dot); then the radius of the supports, and how far each layer moves "
        "the anchors: the line is the median over queries, bands hold half and 90 % of them.",
        {"": tiles} if tiles else {},
        width=600,
    )


def _first_camera(look: Look) -> Cameras:
    """The viewer's first view of a look that is placed in the model's world, (1, 1)."""
    eye, target = (torch.from_numpy(point).double() for point in first_eye(look))
    pose = look_at(eye, target - eye, -up_of(look))
    height, width = _SIZE
    focal = height / 2 / torch.tan(torch.tensor(FIELD_OF_VIEW / 2)).item()
    lens = torch.tensor([focal, focal, width / 2, height / 2])
    return Cameras(pose[None, None].float(), lens[None, None], _SIZE)
