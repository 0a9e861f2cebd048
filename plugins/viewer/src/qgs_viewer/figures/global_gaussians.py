"""Figure: a whole scene from outside, and in it all Gaussians of one query."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qgs.drawing.images import rgb_picture
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.types import Cameras
from qgs_viewer.figures import paper
from qgs_viewer.figures.exhibits import Exhibit, Exhibition
from qgs_viewer.figures.outside import overview, seen_points
from qgs_viewer.figures.paper import SIDE, WIDTH, Made, new_figure, paper_style, picture_panel, tag
from qgs_viewer.placement import corners, on_photo
from qgs_viewer.queries import DrawnQuery, query_picture
from qgs_viewer.stage import FRUSTUM, frustum_lines

SHAPE = (3, 4)  # height to width of a panel


def made(show: Exhibition) -> Made:
    """See `figure`."""
    chosen = {
        e.name: e.notable(1, e.sample.targets.cameras[:, :1], show.query)[0] for e in show.exhibits
    }
    sizes = [
        f"{name}: query {query.index}, whose Gaussians lie {query.dispersion:.3g} from their "
        "centroid in the mean"
        for name, query in chosen.items()
    ]
    why = "The one that was asked for" if show.query is not None else "The heaviest one well inside"
    caption = paper.caption(
        "global_gaussians",
        scene=show.samples[0].scene,
        why=why,
        where=" the first target view" * (show.query is None),
        sizes="; ".join(sizes),
    )
    return Made(figure(show.exhibits, chosen), caption)


@paper_style()
@torch.no_grad()
def figure(exhibits: Sequence[Exhibit], chosen: Mapping[str, DrawnQuery]) -> Figure:
    """A row for each model, from outside what it made: the scene, the Gaussians of its query."""
    drawn = new_figure((WIDTH - 0.2) / 2 * SHAPE[0] / SHAPE[1] * len(exhibits) + 0.25)
    axes = drawn.subplots(len(exhibits), 2, squeeze=False)
    for line, shown in zip(axes, exhibits, strict=True):
        _row(line, shown, chosen[shown.name])
    axes[0, 0].set_title("all Gaussians, seen from outside")
    axes[0, 1].set_title("Gaussians of one query")
    return drawn


def _row(axes: Sequence[Axes], shown: Exhibit, query: DrawnQuery) -> None:
    model, gaussians, inputs = shown.model, shown.gaussians, shown.sample.inputs.cameras
    points = seen_points(shown)
    camera = overview(inputs, points, (SIDE * SHAPE[0] // SHAPE[1], SIDE))
    length = FRUSTUM * float((points - inputs.c2w[0, 0, :3, 3]).norm(dim=-1).median())
    white = torch.ones(3)
    picture_panel(axes[0], rgb_picture(model.render(gaussians, camera, white).rgb[0, 0]))
    picture_panel(axes[1], query_picture(model, gaussians, [query], camera, white))
    tag(axes[1], f"query {query.index}: mean distance to centroid {query.dispersion:.3g}")
    axes[0].set_ylabel(shown.name, labelpad=paper.PAD)
    # The input cameras, as wire frames.
    flat = Cameras(inputs.c2w[0], inputs.intrinsics[0], inputs.size)
    rims = on_photo(flat, corners(inputs.size), length)
    lines = frustum_lines(flat.c2w[:, :3, 3], rims.to(flat.c2w))
    local = to_camera(lines.flatten(0, 1)[None], camera)[0, 0]
    pixels = to_pixels(local, camera.intrinsics[0, 0]).cpu().numpy() - 0.5
    style = {"color": paper.INK_HEX, "linewidth": 0.7, "scalex": False, "scaley": False}
    for axis in axes:
        for x, y in pixels.reshape(-1, 2, 2).transpose(0, 2, 1):
            axis.plot(x, y, **style)
