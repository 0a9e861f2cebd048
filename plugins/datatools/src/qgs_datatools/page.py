"""check.html: what `qgs data check` found, with pictures of cameras and of the worst pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from qgs.drawing.figures import INK, figure_picture, figure_style, hex_color
from qgs.drawing.images import Picture, png_uri
from qgs_datatools.check import CheckReport, SceneReport
from qgs_datatools.epipolar import Pair, epipolar_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ORDER_MAP = "viridis"
_MOST = 120
_DEPTH = 0.09  # of the cameras' extent: how far frusta reach
_RING = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def frusta_figure(scene: SceneReport) -> Figure | None:
    """The cameras that have sound poses, at most 120 of them; None where there is none.

    The figure's vertical axis is the mean of the cameras' up axes.
    """
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    if not len(scene.c2w):
        return None
    kept = np.unique(np.linspace(0, len(scene.c2w) - 1, _MOST).round().astype(int))
    poses = _upright(scene.c2w[kept].astype(float))
    lines = _frusta(poses, scene.fov[kept].astype(float), _extent(poses[:, :, 3]) * _DEPTH)
    with figure_style():
        figure = Figure(figsize=(5.2, 4.4))
        axes: Any = figure.add_axes((0.0, -0.03, 0.95, 1.02), projection="3d")
        colors = _colors(len(poses))
        centres = poses[:, :, 3]
        axes.plot(*centres.T, color=hex_color(INK), linewidth=0.6, alpha=0.5)
        for camera, color in zip(lines, colors, strict=True):
            axes.add_collection3d(Line3DCollection(camera, colors=[color], linewidths=0.9))
        _frame(axes, lines.reshape(-1, 3))
        _order_scale(figure, scene.frames[kept[0]], scene.frames[kept[-1]])
    return figure


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


def _extent(centres: np.ndarray) -> float:
    extent = float(np.ptp(centres, axis=0).max())
    return extent if extent > 0 else 1.0


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


def _colors(count: int) -> np.ndarray:
    from matplotlib import colormaps

    return colormaps[ORDER_MAP](np.linspace(0, 0.92, count))


def _frame(axes: Any, points: np.ndarray) -> None:
    """The same scale along all axes, a bare grid, a view from above and behind."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(0), points.max(0)
    sides = np.maximum(high - low, 0.25 * (high - low).max())
    middle = (low + high) / 2
    axes.set_xlim(middle[0] - sides[0] / 2, middle[0] + sides[0] / 2)
    axes.set_ylim(middle[1] - sides[1] / 2, middle[1] + sides[1] / 2)
    axes.set_zlim(middle[2] - sides[2] / 2, middle[2] + sides[2] / 2)
    axes.set_box_aspect(sides, zoom=1.02)
    axes.view_init(elev=28, azim=-62)
    axes.tick_params(labelsize=6, pad=-2)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1, 1, 1, 0))
        axis.set_major_locator(MaxNLocator(4))


def _order_scale(figure: Figure, first: int, last: int) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colors = ListedColormap(colormaps[ORDER_MAP](np.linspace(0, 0.92, 256)))
    scale = ScalarMappable(Normalize(first, max(last, first + 1)), colors)
    place = figure.add_axes((0.08, 0.96, 0.3, 0.018))
    bar = figure.colorbar(scale, cax=place, orientation="horizontal")
    bar.set_label("frame")
    bar.outline.set_visible(False)  # type: ignore[operator]


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MATCHES = 14
_GAP = 0.02


def pair_figure(pair: Pair, photos: tuple[Picture, ...]) -> Figure:
    """Both photos, in each the matches as dots and the line on which the poses want them.

    A dot off its line of the same colour is what a wrong pose looks like.
    """
    from matplotlib.figure import Figure

    chosen = _spread(pair.matches.first, _MATCHES)
    points = (pair.matches.first[chosen], pair.matches.second[chosen])
    first, second = pair.poses
    lines = epipolar_lines(pair.matches, first, second, pair.intrinsics)
    height, width = pair.size
    with figure_style():
        figure = Figure(figsize=(8.0, 4.0 * height / width * (1 - _GAP) + 0.3))
        axes = figure.subplots(1, 2)
        figure.subplots_adjust(0, 0, 1, 0.93, wspace=_GAP)
        for axis, photo, dots, wanted, frame in zip(
            axes, photos, points, lines, pair.frames, strict=True
        ):
            _photo(axis, photo, dots, wanted[chosen])
            axis.set_title(f"frame {frame}")
    return figure


def _spread(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of points far from each other, the first one nearest the mean."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    apart = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(apart.argmax()))
    return np.array(chosen)


def _photo(axis: Axes, photo: Picture, points: np.ndarray, lines: np.ndarray) -> None:
    from matplotlib import colormaps

    height, width = photo.shape[:2]
    light = (255 - (255 - photo.astype(float)) * 0.6).astype(np.uint8)
    axis.imshow(light, extent=(0, width, height, 0))
    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(points)))
    for point, (a, b, c), color in zip(points, lines, colors, strict=True):
        x, y = _across(a, b, c, width, height)
        axis.plot(x, y, color=color, linewidth=1.0)
        axis.plot(*point, "o", markersize=4.5, color=color, markeredgecolor="white", mew=0.7)
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)


def _across(a: float, b: float, c: float, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Two points of the line a x + b y + c = 0, at the edges that it crosses."""
    if abs(b) >= abs(a):
        x = np.array([0.0, width])
        return x, -(a * x + c) / b
    y = np.array([0.0, height])
    return -(b * y + c) / a, y


PICTURED = 12
"""Scenes that get pictures, the worst first."""

ROWS = 500
"""Scenes in the table, and findings in the list, the worst first."""


@dataclass(frozen=True)
class _Pictured:
    scene: SceneReport
    cameras: Picture | None
    pair: Pair | None
    matches: Picture | None


def check_html(report: CheckReport) -> str:
    """The whole page; it needs no other file and no network."""
    environment = Environment(
        loader=ChoiceLoader(
            [
                PackageLoader("qgs_datatools", "template"),
                PackageLoader("qgs.analysis", "template"),
            ]
        ),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(png=png_uri)
    scenes = _worst_first(report.scenes)
    return environment.get_template("check.html").render(
        report=report,
        scenes=scenes[:ROWS],
        hidden=len(scenes[ROWS:]),
        general=sorted(report.general, key=lambda finding: finding.severity)[:ROWS],
        pictured=[_pictured(scene) for scene in scenes[:PICTURED]],
    )


def _worst_first(scenes: Sequence[SceneReport]) -> list[SceneReport]:
    def badness(scene: SceneReport) -> tuple[int, int, float]:
        judged = scene.geometry is not None and scene.geometry.verdict is not None
        distance = scene.geometry.fraction if judged and scene.geometry else 0.0
        return scene.errors, len(scene.findings), distance

    return sorted(scenes, key=badness, reverse=True)


def _pictured(scene: SceneReport) -> _Pictured:
    cameras = frusta_figure(scene)
    drawn = None if cameras is None else figure_picture(cameras, dpi=130)
    if scene.geometry is None or not scene.geometry.pairs:
        return _Pictured(scene, drawn, None, None)
    worst = scene.geometry.pairs[0]
    matches = figure_picture(pair_figure(worst, scene.geometry.photos), dpi=130)
    return _Pictured(scene, drawn, worst, matches)
