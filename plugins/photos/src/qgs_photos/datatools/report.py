"""The result of a check, scene by scene."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from qgs.geometry.poses import look_at_depth
from qgs.wording import counted, listed
from qgs_photos.datatools.findings import Finding, errors_of
from qgs_photos.datatools.geometry import Geometry


@dataclass(frozen=True)
class SceneReport:
    """What was found in a scene.

    split: empty where the format has none. numbered: photos that a reader has as frames.
    pose_problems: frames whose pose is wrong. c2w: (F, 3, 4) float32 OpenCV poses of `frames`, the
    numbers of those that can be drawn. geometry: None where it was not asked for.
    """

    name: str
    scene: str
    kind: str
    split: str = ""
    listed: int = 0
    decodable: int = 0
    missing: int = 0
    numbered: int = 0
    pose_problems: int = 0
    frames: tuple[int, ...] = ()
    c2w: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 4), np.float32))
    geometry: Geometry | None = None
    findings: Sequence[Finding] = ()

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return len(errors_of(self.findings))

    @property
    def look_at_depth(self) -> float:
        """Depth of what the cameras look at, scene units; 0 where that is no common point."""
        return float(look_at_depth(torch.from_numpy(self.c2w))) if len(self.c2w) > 1 else 0.0

    @property
    def epipolar(self) -> str:
        """Median distance of matches to epipolar lines in pixels, or why there is none."""
        if self.geometry is None:
            return "-"
        return "not judged" if self.geometry.unjudged else f"{self.geometry.pixels:.2f}"


@dataclass(frozen=True)
class CheckReport:
    """The result of `check`. general: findings about files of the data set. judged: how many scenes
    had their poses matched with photos. indices: a line for each. notes: omitted checks, and why.
    """

    path: str
    scenes: Sequence[SceneReport]
    general: Sequence[Finding]
    indices: Sequence[str]
    judged: int
    notes: Sequence[str]

    @property
    def auto_scale(self) -> str:
        """The factors of `views.scale: auto` as text; empty without scenes."""
        depths = {scene.name: scene.look_at_depth for scene in self.scenes}
        factors = sorted(1 / depth for depth in depths.values() if depth)
        none = [name for name, depth in depths.items() if not depth]
        parts = []
        if factors:
            ends = f", from {factors[0]:.4g} to {factors[-1]:.4g}" if len(factors) > 1 else ""
            parts.append(f"is a factor of {np.median(factors):.4g}{ends}")
        if none:
            parts.append(f"finds no common point that the cameras look at in {listed(none)}")
        return f"views.scale: auto {' and '.join(parts)}" if parts else ""

    @property
    def findings(self) -> list[Finding]:
        """All findings, those of files first, then scene by scene; errors before warnings."""
        found = [*self.general, *(f for scene in self.scenes for f in scene.findings)]
        return sorted(found, key=lambda finding: finding.severity != "error")

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return len(errors_of(self.findings))

    @property
    def counts(self) -> Iterator[str]:
        """How many errors and warnings there are, as text."""
        yield counted(self.errors, "error")
        yield counted(len(self.findings) - self.errors, "warning")
