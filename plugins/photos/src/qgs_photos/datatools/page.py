"""check.html: what `qgs data check` found, with pictures of cameras and of the worst pairs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from qgs.drawing import page_environment
from qgs.drawing.figures import INK, figure_picture, figure_style, hex_color
from qgs.drawing.images import Picture, data_uri
from qgs_photos.datatools.check import CheckReport, SceneReport
from qgs_photos.datatools.epipolar import Pair
from qgs_photos.datatools.geometry import Geometry

PICTURED = 12  # scenes that get pictures, the worst first
ROWS = 500  # scenes in the table, and findings in the list, the worst first
_DPI = 130
_CAMERAS, _MATCHES = 120, 14  # drawn at most
_DEPTH = 0.09  # of the cameras' extent: how far frusta reach
_RING = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
_GAP = 0.02  # between two photos, of a photo's width


def check_html(report: CheckReport) -> str:
    """The whole page; it needs no other file and no network."""
    environment = page_environment("qgs_photos.datatools", png=data_uri)
    scenes = sorted(report.scenes, key=_badness, reverse=True)
    return environment.get_template("check.html").render(
        report=report,
        scenes=scenes[:ROWS],
        hidden=len(scenes[ROWS:]),
        general=sorted(report.general, key=lambda finding: finding.severity)[:ROWS],
        pictured=[_pictured(scene) for scene in scenes[:PICTURED]],
    )


def _badness(scene: SceneReport) -> tuple[int, int, float]:
    judged = scene.geometry if scene.geometry and scene.geometry.distances else None
    return scene.errors, len(scene.findings), judged.fraction if judged else 0.0


def _pictured(scene: SceneReport) -> dict[str, Any]:
    frusta = frusta_figure(scene)
    cameras = None if frusta is None else figure_picture(frusta, dpi=_DPI)
    worst = scene.geometry.pairs[0] if scene.geometry and scene.geometry.pairs else None
    figure = pair_figure(worst, scene.geometry) if scene.geometry and worst else None
    matches = None if figure is None else figure_picture(figure, dpi=_DPI)
    return {"scene": scene, "cameras": cameras, "pair": worst, "matches": matches}


def frusta_figure(scene: SceneReport) -> Figure | None:
    """At most 120 cameras with valid poses, their mean up axis upwards; None without any."""
    if not len(scene.c2w):
        return None
    kept = np.unique(np.linspace(0, len(scene.c2w) - 1, _CAMERAS).round().astype(int))
    poses = _upright(scene.c2w[kept].astype(float))
    centres = poses[:, :, 3]
    depth = (float(np.ptp(centres, axis=0).max()) or 1.0) * _DEPTH
    lines = _frusta(poses, scene.fov[kept].astype(float), depth)
    with figure_style():
        figure = Figure(figsize=(5.2, 4.4))
        axes: Any = figure.add_axes((0.0, -0.03, 0.95, 1.02), projection="3d")
        axes.plot(*centres.T, color=hex_color(INK), linewidth=0.6, alpha=0.5)
        for camera, color in zip(lines, _in_order(len(poses)), strict=True):
            axes.add_collection3d(Line3DCollection(camera, colors=[color], linewidths=0.9))
        _frame(axes, lines.reshape(-1, 3))
        first, last = scene.frames[kept[0]], scene.frames[kept[-1]]
        numbers = Normalize(first, max(last, first + 1))
        bar = figure.colorbar(
            ScalarMappable(numbers, ListedColormap(_in_order(256))),
            cax=figure.add_axes((0.08, 0.96, 0.3, 0.018)),
            orientation="horizontal",
        )
        bar.set_label("frame")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _in_order(count: int) -> np.ndarray:
    """Colours (count, 4) from the first frame's to the last one's."""
    return colormaps["viridis"](np.linspace(0, 0.92, count))


def _upright(poses: np.ndarray) -> np.ndarray:
    """(F, 3, 4) poses in a world whose z axis is up and whose y axis is the mean viewing one."""
    up = -poses[:, :, 1].mean(0)
    if np.linalg.norm(up) < 1e-3:
        return poses
    up /= np.linalg.norm(up)
    ahead = poses[:, :, 2].mean(0)
    ahead -= up * (ahead @ up)
    if np.linalg.norm(ahead) < 1e-3:
        ahead = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up]) @ poses


def _frusta(poses: np.ndarray, fov: np.ndarray, depth: float) -> np.ndarray:
    """(F, 8, 2, 3): the edges of every frustum, from its centre to a rectangle at `depth`."""
    reach = depth * np.minimum(1.0, 0.8 / fov.max(1))
    corners = np.concatenate([_RING * fov[:, None], np.ones((len(fov), 4, 1))], 2)
    corners = corners * reach[:, None, None]
    world = np.einsum("fij,fkj->fki", poses[:, :, :3], corners) + poses[:, None, :, 3]
    centre = np.repeat(poses[:, None, :, 3], 4, 1)
    return np.concatenate(
        [np.stack([centre, world], 2), np.stack([world, np.roll(world, -1, 1)], 2)], 1
    )


def _frame(axes: Any, points: np.ndarray) -> None:
    """The same scale along all axes, a bare grid, a view from above and behind."""
    low, high = points.min(0), points.max(0)
    sides = np.maximum(high - low, 0.25 * (high - low).max())
    middle = (low + high) / 2
    for name, centre, side in zip("xyz", middle, sides, strict=True):
        axes.set(**{f"{name}lim": (centre - side / 2, centre + side / 2)})
    axes.set_box_aspect(sides, zoom=1.02)
    axes.view_init(elev=28, azim=-62)
    axes.tick_params(labelsize=6, pad=-2)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1, 1, 1, 0))
        axis.set_major_locator(MaxNLocator(4))


def pair_figure(pair: Pair, geometry: Geometry) -> Figure:
    """Both photos with matches as dots, and the lines on which the poses want them."""
    chosen = _spread(pair.matches[0], _MATCHES)
    points, lines = pair.matches[:, chosen], pair.lines()[:, chosen]
    height, width = pair.size
    with figure_style():
        figure = Figure(figsize=(8.0, 4.0 * height / width * (1 - _GAP) + 0.3))
        axes = figure.subplots(1, 2)
        figure.subplots_adjust(0, 0, 1, 0.93, wspace=_GAP)
        for axis, photo, dots, wanted, label in zip(
            axes, geometry.photos, points, lines, geometry.labels, strict=True
        ):
            _photo(axis, photo, dots, wanted)
            axis.set_title(label)
    return figure


def _spread(points: np.ndarray, count: int) -> Sequence[int]:
    """Indices of points far from each other, the first one nearest the mean."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    distances = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distances.argmax()))
    return chosen


def _photo(axis: Axes, photo: Picture, points: np.ndarray, lines: np.ndarray) -> None:
    height, width = photo.shape[:2]
    light = (255 - (255 - photo.astype(float)) * 0.6).astype(np.uint8)
    axis.imshow(light, extent=(0, width, height, 0))
    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(points)))
    for point, (a, b, c), color in zip(points, lines, colors, strict=True):
        if abs(b) >= abs(a):  # from edge to edge of a x + b y + c = 0
            x = np.array([0.0, width])
            y = -(a * x + c) / b
        else:
            y = np.array([0.0, height])
            x = -(b * y + c) / a
        axis.plot(x, y, color=color, linewidth=1.0)
        axis.plot(*point, "o", markersize=4.5, color=color, markeredgecolor="white", mew=0.7)
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
