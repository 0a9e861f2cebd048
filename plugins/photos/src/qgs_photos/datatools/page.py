"""check.html: what `qgs data check` found, with pictures of cameras and of the worst pairs."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from qgs.drawing import page_environment
from qgs.drawing.figures import INK, figure_picture, figure_style, hex_color
from qgs.drawing.images import Picture, data_uri
from qgs_photos.datatools.epipolar import HalfLines
from qgs_photos.datatools.geometry import Geometry
from qgs_photos.datatools.report import CheckReport, SceneReport

PICTURED = 12  # scenes that get pictures, the worst first
ROWS = 500  # scenes in the table, and findings in the list, the worst first
_DPI = 130
_CAMERAS, _MATCHES = 120, 14  # drawn at most
_DEPTH = 0.09  # of the cameras' extent: how far frusta reach
_WIDEST = 0.8  # tangent of half an angle of view; frusta of wider ones are shorter
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
_GAP = 0.02  # between two photos, of a photo's width


def check_html(report: CheckReport) -> str:
    """Return the whole page; it needs no other file and no network."""
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
    fraction = scene.geometry.fraction if scene.geometry else 0.0
    return scene.errors, len(scene.findings), fraction


def _pictured(scene: SceneReport) -> dict[str, Any]:
    geometry = scene.geometry
    pair = geometry.pairs[0] if geometry and geometry.pairs else None
    return {
        "scene": scene,
        "cameras": figure_picture(frusta_figure(scene), _DPI) if len(scene.c2w) else None,
        "pair": pair,
        "matches": figure_picture(pair_figure(geometry), _DPI) if geometry and pair else None,
    }


def frusta_figure(scene: SceneReport) -> Figure:
    """Draw at most _CAMERAS cameras with valid poses, their mean up axis upwards."""
    kept = np.unique(np.linspace(0, len(scene.c2w) - 1, _CAMERAS).round().astype(int))
    poses = _upright(scene.c2w[kept].astype(float))
    centres = poses[:, :, 3]
    depth = (np.ptp(centres, axis=0).max() or 1.0) * _DEPTH
    fov = scene.fov[kept].astype(float)
    colors = colormaps["viridis"](np.linspace(0, 0.92, len(poses)))
    with figure_style():
        figure = Figure(figsize=(5.2, 4.4))
        axes: Any = figure.add_axes((0.0, -0.03, 0.95, 0.97), projection="3d")
        axes.plot(*centres.T, color=hex_color(INK), linewidth=0.6, alpha=0.5)
        for pose, tangents, color in zip(poses, fov, colors, strict=True):
            lines = _frustum(pose, tangents, depth)
            axes.add_collection3d(Line3DCollection(lines, colors=[color], linewidths=0.9))
        # the same scale along all axes
        middle = (centres.min(0) + centres.max(0)) / 2
        reach = np.ptp(centres, axis=0).max() / 2 + depth
        for name, centre in zip("xyz", middle, strict=True):
            axes.set(**{f"{name}lim": (centre - reach, centre + reach)})
        axes.view_init(elev=28, azim=-62)
        axes.tick_params(labelsize=6, pad=-2)
        last = scene.frames[kept[-1]]
        axes.set_title(f"frame {scene.frames[kept[0]]} dark, frame {last} bright", fontsize=7)
    return figure


def _upright(poses: np.ndarray) -> np.ndarray:
    """Return (F, 3, 4) in a world whose z axis is up and whose y axis is the mean viewing one."""
    up = -poses[:, :, 1].mean(0)
    right = poses[:, :, 0].mean(0)
    right -= up * (right @ up) / max(up @ up, 1e-9)
    if min(np.linalg.norm(up), np.linalg.norm(right)) < 1e-3:
        return poses  # cameras that look everywhere have no mean
    up /= np.linalg.norm(up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up]) @ poses


def _frustum(pose: np.ndarray, tangents: np.ndarray, depth: float) -> np.ndarray:
    """Return the edges (8, 2, 3) of a frustum, from its centre to a rectangle at `depth`."""
    depth *= min(1.0, _WIDEST / max(tangents.max(), 1e-9))
    corners = np.concatenate([_CORNERS * tangents, np.ones((4, 1))], 1) * depth
    world = corners @ pose[:, :3].T + pose[:, 3]
    spokes = np.stack([np.broadcast_to(pose[:, 3], (4, 3)), world], 1)
    rim = np.stack([world, np.roll(world, -1, 0)], 1)
    return np.concatenate([spokes, rim])


def pair_figure(geometry: Geometry) -> Figure:
    """Draw both photos of the worst pair: matches as dots, and lines on which poses want them."""
    pair = geometry.pairs[0]
    chosen = np.linspace(0, pair.matches.shape[1] - 1, _MATCHES).astype(int)
    height, width = pair.size
    with figure_style():
        figure = Figure(figsize=(8.0, 4.0 * height / width * (1 - _GAP) + 0.3))
        axes = figure.subplots(1, 2)
        figure.subplots_adjust(0, 0, 1, 0.93, wspace=_GAP)
        for photo, axis in enumerate(axes):
            points = pair.matches[photo]
            _draw_photo(axis, geometry.photos[photo], points, pair.half_lines(photo), chosen)
            axis.set_title(geometry.labels[photo])
    return figure


def _draw_photo(
    axis: Axes, photo: Picture, points: np.ndarray, lines: HalfLines, chosen: np.ndarray
) -> None:
    height, width = photo.shape[:2]
    light = (255 - (255 - photo.astype(float)) * 0.6).astype(np.uint8)
    axis.imshow(light, extent=(0, width, height, 0))
    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(chosen)))
    # the foot of each point on its line, of which the ends may be far outside
    feet = lines.ends + lines.along(points)[:, None] * lines.directions
    slopes = (lines.directions[:, 1] / lines.directions[:, 0]).tolist()
    for index, color in zip(chosen, colors, strict=True):
        x, y = feet[index]
        axis.axline((x, y), slope=slopes[index], color=color, linewidth=1.0)
        x, y = points[index]
        axis.plot(x, y, "o", markersize=4.5, color=color, markeredgecolor="white", mew=0.7)
    axis.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
