"""check.html: what `qgs data check` found, with pictures of cameras and of the worst pairs."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qgs.drawing import page_environment
from qgs.drawing.figures import INK, figure_picture, figure_style, hex_color
from qgs.drawing.images import Picture, data_uri
from qgs_photos.datatools.epipolar import HalfLines
from qgs_photos.datatools.geometry import Geometry
from qgs_photos.datatools.report import CheckReport, SceneReport

# Scenes that get pictures, the worst first.
PICTURED = 12
# Scenes in the table, and findings in the list, the worst first.
ROWS = 500
_DPI = 130
# Drawn at most.
_CAMERAS, _MATCHES = 120, 14
# Between two photos, of a photo's width.
_GAP = 0.02


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
        "cameras": figure_picture(cameras_figure(scene), _DPI) if len(scene.c2w) else None,
        "pair": pair,
        "matches": figure_picture(pair_figure(geometry), _DPI) if geometry and pair else None,
    }


def cameras_figure(scene: SceneReport) -> Figure:
    """Draw at most _CAMERAS cameras with valid poses from above, as arrows along their views."""
    kept = np.unique(np.linspace(0, len(scene.c2w) - 1, _CAMERAS).round().astype(int))
    poses = scene.c2w[kept].astype(float)
    # up is the cameras' mean up: files have any axis up
    down = poses[:, :, 1].mean(0)
    right = np.cross(down, poses[0, :, 2])
    plane = np.stack([right, np.cross(right, down)])
    plane /= np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-9)
    frames = np.array(scene.frames)[kept]
    places = poses[:, :, 3] @ plane.T
    views = poses[:, :, 2] @ plane.T
    with figure_style():
        figure = Figure(figsize=(5.2, 4.4))
        axes = figure.subplots()
        axes.plot(*places.T, color=hex_color(INK), linewidth=0.6, alpha=0.5)
        arrows = axes.quiver(*places.T, *views.T, frames, cmap="viridis", width=0.006)
        axes.set_aspect("equal", adjustable="datalim")
        figure.colorbar(arrows, label="frame, seen from above")
    return figure


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
    # pale, so that dots and lines stand out
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
