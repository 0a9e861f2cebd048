"""All scenes of a data set, whatever its format, and its evaluation indices."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from upath import UPath

from qgs.data.photos import read_listing, readers
from qgs.geometry.poses import look_at_depth
from qgs.wording import counted, listed
from qgs_photos.datatools.cameras import camera_findings, sharing_findings
from qgs_photos.datatools.candidates import Candidate
from qgs_photos.datatools.chunks import chunk_folders
from qgs_photos.datatools.decoding import (
    DecodedScene,
    decode,
    error_text,
    file_findings,
    size_findings,
)
from qgs_photos.datatools.findings import Finding, errors_of, merged
from qgs_photos.datatools.folders import dl3dv_scenes, photo_folders
from qgs_photos.datatools.geometry import TOO_FEW, Geometry, geometry_findings, judge_scene
from qgs_photos.datatools.indices import Held, found_indices, index_findings
from qgs_photos.datatools.masks import matched_findings, picture_findings
from qgs_photos.datatools.sources import OF_FILES, kind_of, left_out, source_scenes, sources

PHOTOS, FEWEST = 400, 20
"""Photos that are matched in all, half a second each, and in a scene at least."""


@dataclass(frozen=True)
class Options:
    """How thorough a check is: the options of `qgs data check`; format may also be PLUGIN/NAME."""

    geometry: int = 20
    headers_only: bool = False
    threads: int = 8
    format: str = "auto"
    images: str | None = None


@dataclass(frozen=True)
class SceneReport:
    """What was found in a scene.

    split: empty where the format has none. numbered: photos that a reader has as frames.
    pose_problems: frames whose pose is wrong. c2w: (F, 3, 4) float32 OpenCV poses of `frames`, the
    numbers of those that can be drawn; fov: (F, 2) tangents of half the angles of view, x and y.
    geometry: None where it was not asked for.
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
    fov: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    geometry: Geometry | None = None
    findings: Sequence[Finding] = ()

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return len(errors_of(self.findings))

    @property
    def partly_judged(self) -> bool:
        """Whether photos were left out when the cameras were judged."""
        return self.geometry is not None and self.geometry.left_out > 0

    @property
    def look_at_depth(self) -> float:
        """Depth of what the cameras look at, scene units; 0 where that is no common point."""
        return float(look_at_depth(torch.from_numpy(self.c2w))) if len(self.c2w) > 1 else 0.0

    @property
    def epipolar(self) -> str:
        """Median distance of matches to epipolar lines in pixels, or why there is none."""
        if self.geometry is None:
            return "-"
        return f"{self.geometry.pixels:.2f}" if self.geometry.distances else "not judged"


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
        depths = [scene.look_at_depth for scene in self.scenes]
        factors = sorted(1 / depth for depth in depths if depth)
        none = [scene.name for scene in self.scenes if not scene.look_at_depth]
        parts = []
        if factors:
            middle, ends = np.median(factors), f", from {factors[0]:.4g} to {factors[-1]:.4g}"
            parts += [f"is a factor of {middle:.4g}{ends if len(factors) > 1 else ''}"]
        if none:
            parts += [f"finds no common point that the cameras look at in {listed(none)}"]
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


def check(
    path: UPath,
    options: Options,
    indices: Sequence[UPath] = (),
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> CheckReport:
    """Check the data set at `path`, and evaluation indices: those given and those beside it.

    progress: called with scenes done, scenes in all and a name. Raises FileNotFoundError without a
    data set or an index, MissingExtraError for the format, ValueError for an unknown one.
    """
    formats = (
        "auto",
        *readers(),
        "dl3dv",
        "chunks",
        *(kind for kind in sources(options.format) if kind.partition("/")[0] not in OF_FILES),
    )
    if options.format not in formats:
        usable = f"{', '.join(formats)}, or PLUGIN/NAME of a source that reads a path"
        raise ValueError(f"there is no format {options.format!r}: use one of {usable}")
    if path.is_file() and path.suffix in (".json", ".npy"):
        path = path.parent
    candidates, general, reported = _candidates(path, options)
    if not candidates and not general:
        read_listing(path, _photo_format(options))  # raises: what is missing for a photo folder
        raise FileNotFoundError(f"{path} holds no {options.format}: leave --format out")
    judged, notes = _scenes_to_judge(len(candidates), options)
    scenes: list[SceneReport] = []
    held: dict[str, list[Held]] = defaultdict(list)
    for number, candidate in enumerate(candidates):
        progress(number, len(candidates), candidate.name)
        most = max(PHOTOS // len(judged), FEWEST) if number in judged else 0
        report = check_scene(candidate, options, most)
        scenes.append(report)
        held[report.scene].append(Held(report.split, report.numbered or None))
    summaries: list[str] = []
    for file in dict.fromkeys(file.resolve() for file in (*indices, *found_indices(path))):
        findings, summary = index_findings(file, held, reported)
        general += findings
        summaries += [summary] if summary else []
    if partly := sum(scene.partly_judged for scene in scenes):
        notes.append(
            f"in {counted(partly, 'scene')} only some of the photos were matched "
            "with others; a lower --geometry judges fewer scenes by more of theirs"
        )
    notes = [*left_out(options.format), *notes]
    return CheckReport(str(path), scenes, general, summaries, len(judged), notes)


def _candidates(path: UPath, options: Options) -> tuple[list[Candidate], list[Finding], set[str]]:
    """Scenes, findings about files, and names of scenes that such findings may be about."""
    kind = options.format
    if kind == "auto":
        is_chunk = path.is_file() and path.suffix == ".torch"
        kind = "chunks" if is_chunk else kind_of(path)
    if kind == "chunks":
        if options.images is not None:
            raise ValueError("chunks hold their images: leave --images out")
        folders = chunk_folders(path)
        return (
            [candidate for folder in folders for candidate in folder.candidates],
            [finding for folder in folders for finding in folder.findings],
            {key for folder in folders for key in folder.index},
        )
    if kind == "dl3dv":
        return dl3dv_scenes(path, options.images), [], set()
    if "/" in kind:
        return list(source_scenes(kind, path, options.images)), [], set()
    items = list(photo_folders(path, _photo_format(options), options.images))
    return (
        [item for item in items if isinstance(item, Candidate)],
        [item for item in items if isinstance(item, Finding)],
        set(),
    )


def _photo_format(options: Options) -> str:
    return options.format if options.format in readers() else "auto"


def _scenes_to_judge(count: int, options: Options) -> tuple[set[int], list[str]]:
    """Numbers of the scenes whose poses are matched with photos, and a note on the others."""
    if options.headers_only:
        return set(), ["quick: only headers of images were read, and no pose was judged by photos"]
    if not options.geometry:
        return set(), ["no pose was judged by photos (--geometry 0)"]
    places = np.linspace(0, max(count - 1, 0), min(options.geometry, count)).round().astype(int)
    left = f"poses were judged by photos in {len({*places})} of {count} scenes; --geometry {count}"
    return set(places.tolist()), [f"{left} judges all"] if len({*places}) < count else []


def check_scene(candidate: Candidate, options: Options, most_photos: int) -> SceneReport:
    """Check one scene; every fault becomes a finding. Raises as `check`.

    most_photos: that are matched with each other, to judge its cameras.
    """
    name = candidate.name
    report = SceneReport(name, candidate.scene, candidate.kind, candidate.split)
    try:
        photos, missing = candidate.photos(), candidate.missing()
    except Exception as error:  # whatever a reader raises; the other scenes go on
        reason, colon, fix = str(error).rpartition(": ")  # messages end with a remedy
        if not colon or not isinstance(error, OSError | ValueError):
            reason, fix = error_text(error), "get the files again, or mend what reads them"
        return replace(report, findings=[Finding(name, reason, fix)])
    reason = f"listed images that do not exist: {listed(missing, 3)}; later frames move up"
    fix = "add the files, or take them out of what lists them"
    absent = [Finding(name, f"{reason} in an index", fix)] if missing else []
    if not photos:
        nothing = Finding(name, "no photos are listed", "export the scene again")
        return replace(report, findings=absent or [nothing])
    with ThreadPoolExecutor(options.threads) as pool:
        decoded = pool.map(partial(decode, headers_only=options.headers_only), photos)
    scene = DecodedScene(name, photos, list(decoded))
    if (there := sum(photo.exists for photo in photos)) < 2:
        fix = "add photos, or take the scene out"
        absent.append(Finding(name, f"{there} photos are there, and a scene needs 2", fix))
    listings = {name: reader.listing for name, reader in readers().items()}
    listings |= {"dl3dv": "transforms.json", "chunks": "the chunk"}
    files = list(file_findings(scene, listings.get(candidate.kind, "the data set")))
    sizes = list(size_findings(scene))
    poses, others = camera_findings(scene, _frames(sizes))
    placed = [
        frame
        for frame, photo in enumerate(photos)
        if frame not in _frames(poses) and np.isfinite(photo.listed.c2w).all()
    ]
    sharing = list(sharing_findings(scene, placed, float32=candidate.kind == "chunks"))
    pictures = list(picture_findings(scene))
    findings = merged([*absent, *files, *sizes, *poses, *others, *sharing, *pictures])
    geometry = None
    if most_photos:
        faulty = _frames([*sizes, *others, *sharing])
        usable = [f for f in placed if f not in faulty and scene.decoded[f].size is not None]
        geometry = judge_scene(scene, usable, candidate.convention, most_photos)
        explained = errors_of(findings) and geometry.unjudged != TOO_FEW
        if geometry.distances or not explained:
            findings += geometry_findings(scene, geometry, candidate.convention)
        findings += matched_findings(scene, geometry.pairs)
    return replace(
        report,
        listed=len(photos) + len(missing),
        decodable=sum(result.size is not None for result in scene.decoded),
        missing=len(missing) + sum(not photo.exists for photo in photos),
        numbered=sum(number is not None for number in scene.numbers),
        pose_problems=len(_frames([*poses, *sharing])),
        geometry=geometry,
        findings=findings,
        **_drawn(scene, placed),
    )


def _frames(findings: Sequence[Finding]) -> set[int]:
    return {frame for finding in errors_of(findings) for frame in finding.frames}


def _drawn(scene: DecodedScene, frames: Sequence[int]) -> dict[str, Any]:
    """What a picture of the cameras needs."""
    frames = [frame for frame in frames if scene.numbers[frame] is not None]
    if not frames:
        return {}
    fov, c2w = [], []
    for frame in frames:
        photo = scene.photos[frame].listed
        height, width = photo.size or scene.decoded[frame].size or (1, 1)
        sides = zip((width, height), photo.intrinsics, strict=False)
        fov.append([side / 2 / focal if focal > 0 else 0.0 for side, focal in sides])
        c2w.append(photo.c2w[:3])
    drawn = {"c2w": np.array(c2w, np.float32), "fov": np.array(fov, np.float32)}
    return {"frames": tuple(scene.numbers[frame] for frame in frames), **drawn}
