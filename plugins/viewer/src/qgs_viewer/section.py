"""Sections of report.html: the scene to turn, refinement, self-attention, dispersion by scene."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from qgs.data.samples import Sample
from qgs.drawing.images import rgb_picture, side_by_side
from qgs.geometry.poses import look_at, scaled
from qgs.types import Cameras
from qgs_viewer.choice import Choice
from qgs_viewer.figures import anchors, attention, dispersion
from qgs_viewer.figures.exhibits import Exhibit, exhibit
from qgs_viewer.page import scenes_html, shared_start
from qgs_viewer.placement import Placement
from qgs_viewer.report import ReportSection, Shown, Tile, drawn_section, ratio, samples_of, titled
from qgs_viewer.server import FIELD_OF_VIEW, first_eye, up_of

_SIZE = 240, 320  # of each scene's picture, H, W


def sections(shown: Shown, samples: Sequence[Sample]) -> Iterator[ReportSection]:
    """All of them, of one look at what every model makes of the first of `samples`."""
    exhibits = [exhibit(c.name, c.model, samples_of(c, samples)[0]) for c, _ in shown]
    # one camera looks at all scenes, so they need one scale
    places = [replace(Placement.identity(), scale=ratio(samples[0], e.sample)) for e in exhibits]
    pairs = zip(exhibits, places, strict=True)
    yield scene_section([replace(e, look=replace(e.look, placement=p)) for e, p in pairs])
    anchored = [shown for shown in exhibits if shown.look.support(0) is not None]
    yield drawn_section("refinement", anchors.refinement_figure(anchored) if anchored else None)
    attending, chosen = attention.self_attending(exhibits)
    graph = attention.self_attention_figure(attending, chosen) if attending else None
    numbers = {"queries": attention.QUERIES, "edges": attention.EDGES}
    yield drawn_section("self_attention", graph, **numbers)
    # Bars of one scene would repeat the table.
    yield dispersion_section(shown, samples)


def scene_section(exhibits: Sequence[Exhibit]) -> ReportSection:
    """What every model makes of the scene, side by side, as it can be turned."""
    looks = {shown.name: shown.look for shown in exhibits}
    start = shared_start(looks.values())
    eye, target = (torch.from_numpy(point).double() for point in first_eye(start))
    height, width = _SIZE
    focal = height / 2 / torch.tan(torch.tensor(FIELD_OF_VIEW / 2)).item()
    lens = torch.tensor([focal, focal, width / 2, height / 2])
    pose = look_at(eye, target - eye, -up_of(start))  # as viewers stand at first
    camera = Cameras(pose[None, None].float(), lens[None, None], _SIZE)
    own = {
        shown.name: replace(camera, c2w=scaled(camera.c2w, 1 / shown.look.placement.scale))
        for shown in exhibits
    }
    with torch.no_grad():
        views = [e.model.render(e.gaussians, own[e.name]).rgb[0, 0] for e in exhibits]
    choices = {
        shown.name: Choice(
            query=shown.notable(1, own[shown.name])[0].index,
            layer=shown.look.depth,
            others="shown",
        )
        for shown in exhibits
        if shown.look.support(0) is not None
    }
    pictures = side_by_side([rgb_picture(view) for view in views])
    tile = Tile(pictures, ", ".join(looks), page=scenes_html(looks, choices))
    return titled("scene", {"": [tile]}, width=600)


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
        "dispersion", dispersion.figure(found, labels) if len(samples) > 1 else None
    )
