"""Everything that is checked of one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from qgs.data.check.cameras import camera_findings, sharing_findings
from qgs.data.check.decoding import Decoded, decode_all, file_findings
from qgs.data.check.finding import Finding, merged
from qgs.data.check.geometry import TOO_FEW, Geometry, geometry_findings, judge_scene
from qgs.data.check.photo import Candidate, Photo
from qgs.data.check.sizes import size_findings

_LISTS = {
    "nerfstudio": "transforms.json",
    "dl3dv": "transforms.json",
    "blender": "its transforms file",
    "colmap": "the model",
    "llff": "poses_bounds.npy",
    "chunks": "the chunk",
}


@dataclass(frozen=True)
class SceneReport:
    """What was found in a scene.

    split: train or test, empty where the format has none. listed, decodable, missing: numbers of
    photos. pose_problems: of frames whose pose is wrong. c2w: (F, 3, 4) float32 OpenCV poses of
    `frames`, those that can be drawn; fov: (F, 2) tangents of half the angles of view, x and y.
    geometry: None where it was not asked for.
    """

    name: str
    scene: str
    kind: str
    split: str = ""
    listed: int = 0
    decodable: int = 0
    missing: int = 0
    pose_problems: int = 0
    frames: tuple[int, ...] = ()
    c2w: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 4), np.float32))
    fov: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    geometry: Geometry | None = None
    findings: Sequence[Finding] = ()

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return sum(finding.severity == "error" for finding in self.findings)

    @property
    def epipolar(self) -> str:
        """Median distance of matches to epipolar lines in pixels, or why there is none."""
        if self.geometry is None:
            return "-"
        if self.geometry.verdict is None:
            return "not judged"
        return f"{self.geometry.pixels:.2f}"


def check_scene(
    candidate: Candidate, *, threads: int, headers_only: bool, with_geometry: bool
) -> SceneReport:
    """Check one scene; whatever is wrong with it becomes a finding.

    Raises MissingExtraError when a package that its format or the matching needs is missing.
    """
    report = SceneReport(candidate.name, candidate.scene, candidate.kind, candidate.split)
    try:
        photos = candidate.photos()
    except (OSError, ValueError) as error:
        return replace(report, findings=[Finding(candidate.name, *_reason_and_fix(error))])
    if not photos:
        nothing = Finding(candidate.name, "no photos are listed", "export the scene again")
        return replace(report, findings=[nothing])
    decoded = decode_all(photos, threads, headers_only)
    return _judged(report, candidate, photos, decoded, with_geometry)


def _judged(
    report: SceneReport,
    candidate: Candidate,
    photos: Sequence[Photo],
    decoded: Sequence[Decoded],
    with_geometry: bool,
) -> SceneReport:
    name = candidate.name
    files = file_findings(name, photos, decoded, _LISTS[candidate.kind])
    sizes = size_findings(name, photos, decoded)
    poses, others = camera_findings(name, photos, decoded, _frames(sizes))
    placed = [frame for frame in range(len(photos)) if frame not in _frames(poses)]
    placed = [frame for frame in placed if np.isfinite(photos[frame].listed.c2w).all()]
    sharing = sharing_findings(name, photos, decoded, placed, float32=candidate.kind == "chunks")
    findings = merged([*files, *sizes, *poses, *others, *sharing])
    geometry = None
    if with_geometry:
        unsound = _frames([*sizes, *others, *sharing])
        sound = [f for f in placed if f not in unsound and decoded[f].size is not None]
        geometry = judge_scene(photos, decoded, sound, candidate.convention)
        if geometry.verdict is not None or not _explained(findings, geometry):
            findings += geometry_findings(name, geometry, photos, candidate.convention)
    return replace(
        report,
        listed=len(photos),
        decodable=sum(result.size is not None for result in decoded),
        missing=sum(not photo.exists for photo in photos),
        pose_problems=len(_frames([*poses, *sharing])),
        geometry=geometry,
        findings=findings,
        **_drawn(photos, decoded, placed),
    )


def _drawn(
    photos: Sequence[Photo], decoded: Sequence[Decoded], frames: Sequence[int]
) -> dict[str, Any]:
    """What a picture of the cameras needs."""
    if not frames:
        return {}
    fov = []
    for frame in frames:
        listed = photos[frame].listed
        height, width = listed.size or decoded[frame].size or (1, 1)
        fov.append((width / 2 / listed.intrinsics[0], height / 2 / listed.intrinsics[1]))
    c2w = np.stack([photos[frame].listed.c2w[:3] for frame in frames])
    return {
        "frames": tuple(frames),
        "c2w": c2w.astype(np.float32),
        "fov": np.array(fov, np.float32),
    }


def _frames(findings: Sequence[Finding]) -> set[int]:
    return {
        frame for finding in findings if finding.severity == "error" for frame in finding.frames
    }


def _explained(findings: Sequence[Finding], geometry: Geometry) -> bool:
    """Whether other findings are why there is no verdict."""
    return geometry.unjudged != TOO_FEW and any(f.severity == "error" for f in findings)


def _reason_and_fix(error: Exception) -> tuple[str, str]:
    """Readers end what they raise with a remedy behind the last colon."""
    reason, colon, fix = str(error).rpartition(": ")
    return (reason, fix) if colon else (str(error), "get the files again")
