"""`qgs data check`: all scenes of a data set, whatever its format."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from upath import UPath

from qgs.data.photos import READERS, Format, read_listing
from qgs_datatools.cameras import camera_findings, sharing_findings
from qgs_datatools.decoding import Decoded, decode_all, file_findings, size_findings
from qgs_datatools.findings import Candidate, Finding, Photo, merged
from qgs_datatools.folders import (
    Held,
    IndexSummary,
    chunk_folders,
    dl3dv_scenes,
    found_indices,
    index_findings,
    photo_folders,
)
from qgs_datatools.geometry import TOO_FEW, Geometry, geometry_findings, judge_scene
from qgs_datatools.sources import kind_of, source_scenes, sources

_PHOTO_FORMATS = {reader.name: reader.listing for reader in READERS}
_LISTS = {**_PHOTO_FORMATS, "dl3dv": "transforms.json", "chunks": "the chunk"}


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
    files = file_findings(name, photos, decoded, _LISTS.get(candidate.kind, "the data set"))
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


_LISTINGS = (".json", ".npy")


@dataclass(frozen=True)
class Options:
    """How thorough a check is.

    geometry: poses are judged against photos in so many scenes, spread over the data set.
    headers_only: no image is decoded, and none is matched. images: folder of photos to read instead
    of the listed one, such as images_4. format: of photos, chunks, dl3dv or PLUGIN/NAME of a
    plugin's source; auto tells it from what is there.
    """

    geometry: int = 20
    headers_only: bool = False
    threads: int = 8
    format: str = "auto"
    images: str | None = None


@dataclass(frozen=True)
class CheckReport:
    """What was found. general: findings about files of the data set. judged: scenes whose poses
    were to be judged against photos. notes: what was not done, and why.
    """

    path: str
    scenes: Sequence[SceneReport]
    general: Sequence[Finding]
    indices: Sequence[IndexSummary]
    judged: int
    notes: Sequence[str]

    @property
    def findings(self) -> list[Finding]:
        """All findings, those of files first, then scene by scene; errors before warnings."""
        found = [*self.general, *(f for scene in self.scenes for f in scene.findings)]
        return sorted(found, key=lambda finding: finding.severity != "error")

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return sum(finding.severity == "error" for finding in self.findings)


def check(
    path: UPath,
    options: Options,
    indices: Sequence[UPath] = (),
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> CheckReport:
    """Check the data set at `path`, and evaluation indices: those given and those beside it.

    progress: called with scenes done, scenes in all and a name. Raises FileNotFoundError when there
    is no data set at `path`, or no file at one of `indices`, ValueError for an unknown format.
    """
    formats = ("auto", *_LISTS, *(kind for kind in sources() if not kind.startswith("qgs/")))
    if options.format not in formats:
        raise ValueError(f"there is no format {options.format!r}: use one of {', '.join(formats)}")
    if path.is_file() and path.suffix in _LISTINGS:
        path = path.parent
    candidates, general, told = _candidates(path, options)
    if not candidates and not general:
        read_listing(path, _photo_format(options))  # tells what is missing
        raise FileNotFoundError(f"{path} holds no {options.format}: leave --format out")
    chosen, notes = _geometry_scenes(len(candidates), options)
    scenes: list[SceneReport] = []
    for number, candidate in enumerate(candidates):
        progress(number, len(candidates), candidate.name)
        scenes.append(
            check_scene(
                candidate,
                threads=options.threads,
                headers_only=options.headers_only,
                with_geometry=number in chosen,
            )
        )
    summaries: list[IndexSummary] = []
    held = _held(scenes)
    for file in dict.fromkeys(file.resolve() for file in (*indices, *found_indices(path))):
        findings, summary = index_findings(file, held, told)
        general += findings
        summaries += [summary] if summary else []
    return CheckReport(str(path), scenes, general, summaries, len(chosen), notes)


def _candidates(path: UPath, options: Options) -> tuple[list[Candidate], list[Finding], set[str]]:
    """Scenes, findings about files, and names of scenes that such findings may be about."""
    kind = _kind(path, options.format)
    if kind == "chunks":
        folders = chunk_folders(path)
        return (
            [candidate for folder in folders for candidate in folder.candidates],
            [finding for folder in folders for finding in folder.findings],
            {key for folder in folders for key in folder.index},
        )
    if kind == "dl3dv":
        return dl3dv_scenes(path, options.images), [], set()
    if "/" in kind:
        return list(source_scenes(kind, path)), [], set()
    items = list(photo_folders(path, _photo_format(options), options.images))
    return (
        [item for item in items if isinstance(item, Candidate)],
        [item for item in items if isinstance(item, Finding)],
        set(),
    )


def _photo_format(options: Options) -> Format:
    return options.format if options.format in _PHOTO_FORMATS else "auto"


def _kind(path: UPath, wanted: str) -> str:
    if wanted != "auto":
        return wanted
    if path.is_file() and path.suffix == ".torch":
        return "chunks"
    return kind_of(path)


def _geometry_scenes(count: int, options: Options) -> tuple[set[int], list[str]]:
    """The scenes whose poses are judged against photos, and what to tell of the others."""
    if options.headers_only:
        return set(), ["quick: only headers of images were read, and no pose was judged by photos"]
    if find_spec("skimage") is None:
        return set(), [
            "no pose was judged by photos, which needs scikit-image: `pip install scikit-image`"
        ]
    if not options.geometry:
        return set(), ["no pose was judged by photos (--geometry 0)"]
    places = np.linspace(0, max(count - 1, 0), min(options.geometry, count)).round().astype(int)
    chosen = set(places.tolist())
    if len(chosen) < count:
        left = f"poses were judged by photos in {len(chosen)} of {count} scenes; --geometry {count}"
        return chosen, [f"{left} judges all"]
    return chosen, []


def _held(scenes: Sequence[SceneReport]) -> dict[str, list[Held]]:
    held: dict[str, list[Held]] = defaultdict(list)
    for scene in scenes:
        held[scene.scene].append(Held(scene.split, scene.listed - scene.missing or None))
    return held
