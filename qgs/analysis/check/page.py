"""The page itself: the worst scenes in pictures, all of them in a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from qgs.analysis.check.frusta import frusta_figure
from qgs.analysis.check.pairs import pair_figure
from qgs.analysis.pictures.figures import figure_picture
from qgs.analysis.report.page import png_uri
from qgs.data.check.dataset import CheckReport
from qgs.data.check.epipolar import Pair
from qgs.data.check.scene import SceneReport
from qgs.io.drawing import Picture

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
                PackageLoader("qgs.analysis.check", "template"),
                PackageLoader("qgs.analysis.report", "template"),
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
