"""Cameras of a scene as a figure: frusta in photo order, coloured from first to last."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from qgs.analysis.pictures.palette import INK, figure_style, hex_color
from qgs.data.check.scene import SceneReport

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
