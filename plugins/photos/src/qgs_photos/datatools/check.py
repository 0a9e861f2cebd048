"""Check all scenes of a data set in any format, and its evaluation indices."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from upath import UPath

from qgs.data.photos import read_listing, readers
from qgs.data.recognition import recognised
from qgs.geometry.poses import look_at_depth
from qgs.wording import listed
from qgs_photos.datatools.candidates import (
    OF_FILES,
    Items,
    chunk_scenes,
    dl3dv_scenes,
    photo_folders,
    source_scenes,
    sources,
)
from qgs_photos.datatools.faults import photo_findings, pose_findings, sharing_findings
from qgs_photos.datatools.findings import CheckReport, Finding, SceneReport, errors_of, merged
from qgs_photos.datatools.geometry import TOO_FEW, geometry_findings, judge_scene
from qgs_photos.datatools.indices import found_indices, index_findings
from qgs_photos.datatools.photos import Candidate, DecodedScene, Photo, decode, error_text

PHOTOS = 400
"""Number of photos to match in a data set, divided among the scenes whose poses are checked.
Matching takes about half a second for each photo."""
FEWEST = 20
"""Least number of photos to match in a scene, even if the scenes together then exceed PHOTOS."""


@dataclass(frozen=True)
class Options:
    """Options of `qgs data check`.

    geometry: number of scenes whose poses are checked by matching photos. headers_only: read only
    the headers of images, and match no photos. threads: number of threads that decode images.
    format: name of a format, PLUGIN/NAME of a data source, or "auto" to recognise the format.
    images: folder of photos inside each scene; None takes the format's default.
    """

    geometry: int = 20
    headers_only: bool = False
    threads: int = 8
    format: str = "auto"
    images: str | None = None


def check(
    path: UPath,
    options: Options,
    indices: Sequence[UPath] = (),
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> CheckReport:
    """Check the data set at `path`, the evaluation indices in it, and those in `indices`.

    progress: called before each scene with the number of scenes done, the number of all scenes, and
    the scene's name. Raises FileNotFoundError if a data set or an index does not exist,
    MissingExtraError if the format needs a package that is not installed, ValueError for an unknown
    format.
    """
    _refuse_unknown(options.format)
    # a listing stands for its folder
    if path.is_file() and path.suffix in (".json", ".npy"):
        path = path.parent
    items = list(_items(path, options))
    candidates = [item for item in items if isinstance(item, Candidate)]
    general = [item for item in items if isinstance(item, Finding)]
    if not items:
        # raises: what is missing for a photo folder
        read_listing(path, options.format if options.format in readers() else "auto")
        raise FileNotFoundError(
            f"{path} holds no data of the format {options.format}: leave --format out to check any "
            "format"
        )
    count = len(candidates)
    # over the whole data set: faults come in batches of scenes
    wanted = 0 if options.headers_only else min(options.geometry, count)
    judged = {*np.linspace(0, max(count - 1, 0), wanted).round().astype(int).tolist()}
    notes = list[str]()
    if len(judged) < count:
        some = f"poses were checked by photos in {len(judged)} of {count} scenes"
        notes.append(f"{some}; --geometry {count} checks all")
    scenes = list[SceneReport]()
    for number, candidate in enumerate(candidates):
        progress(number, count, candidate.name)
        most = max(PHOTOS // len(judged), FEWEST) if number in judged else 0
        scenes.append(check_scene(candidate, options, most))
    for file in dict.fromkeys(file.resolve() for file in (*indices, *found_indices(path))):
        general += index_findings(file, scenes)
        notes.append(f"scenes were compared with the index {file}")
    if factors := [1 / scene.depth for scene in scenes if scene.depth]:
        ends = f"{min(factors):.4g} to {max(factors):.4g}"
        median = f"{np.median(factors):.4g}"
        notes.append(f"`views.scale: auto` scales by {median} (median of scenes; range {ends})")
    else:
        notes.append("`views.scale: auto` finds no common point that the cameras look at")
    return CheckReport(scenes=scenes, general=general, notes=notes)


def faults_of_poses(path: UPath, scene: str | None, most_photos: int) -> list[Finding]:
    """Check one scene without decoding all photos, and return the errors that are found.

    scene: name of the scene if `path` holds several; None takes the first. most_photos: largest
    number of photos to match. Raises the errors of `check`.
    """
    options = Options(headers_only=True)
    for item in _items(path, options):
        if isinstance(item, Candidate) and scene in (None, item.name):
            return errors_of(check_scene(item, options, most_photos).findings)
    return []


def _refuse_unknown(format: str) -> None:
    of_plugins = [kind for kind in sources(format) if kind.partition("/")[0] not in OF_FILES]
    known = ["auto", *readers(), "dl3dv", "chunks", *of_plugins]
    if format not in known:
        usable = f"{', '.join(known)}, or PLUGIN/NAME of a data source with an option `path`"
        raise ValueError(f"there is no format {format!r}: use one of {usable}")


def _items(path: UPath, options: Options) -> Items:
    """Yield the scenes to check, and findings about files of the data set."""
    kind = options.format
    if kind == "auto":
        kind = recognised(path, sources())
        for plugin in OF_FILES:
            kind = kind.removeprefix(f"{plugin}/")
    if kind == "chunks":
        if options.images is not None:
            raise ValueError("chunks have no folders of images to choose: leave --images out")
        return chunk_scenes(path)
    if kind == "dl3dv":
        return dl3dv_scenes(path, options.images)
    if "/" in kind:
        return source_scenes(kind, path, options.images)
    return photo_folders(path, options.format, options.images)


def check_scene(candidate: Candidate, options: Options, most_photos: int) -> SceneReport:
    """Check one scene, and return a report in which every fault is a finding.

    most_photos: largest number of photos to match with each other to check the cameras; 0 matches
    none.
    """
    report = partial(SceneReport, candidate.name, candidate.kind, candidate.split)
    try:
        photos, missing = candidate.photos()
    except Exception as error:
        # whatever a reader raises; the other scenes go on
        return report(findings=[_unreadable(candidate.name, error)])
    absent = list(_absent(candidate.name, photos, missing))
    if not photos:
        return report(findings=absent)
    with ThreadPoolExecutor(options.threads) as pool:
        decoded = list(pool.map(partial(decode, headers_only=options.headers_only), photos))
    scene = DecodedScene(candidate.name, photos, decoded)
    of_photos = list(photo_findings(scene))
    poses = list(pose_findings(scene))
    faulty_poses = _frames(poses)
    placed = [
        frame
        for frame, photo in enumerate(photos)
        if frame not in faulty_poses and np.isfinite(photo.listed.c2w).all()
    ]
    sharing = list(sharing_findings(scene, placed))
    findings = merged([*absent, *of_photos, *poses, *sharing])
    epipolar = "-"
    if most_photos:
        faulty = _frames([*of_photos, *sharing])
        usable = [f for f in placed if f not in faulty and decoded[f].size is not None]
        geometry = judge_scene(scene, usable, most_photos)
        epipolar = "not checked" if geometry.unjudged else f"{geometry.pixels:.2f}"
        # what else is wrong says already why nothing could be judged
        explained = errors_of(findings) and geometry.unjudged not in ("", TOO_FEW)
        if not explained:
            findings += geometry_findings(scene, geometry)
    c2w = np.array([photos[f].listed.c2w for f in placed if scene.numbers[f] is not None])
    return report(
        listed=len(photos) + len(missing),
        decodable=sum(result.size is not None for result in decoded),
        missing=len(missing) + sum(not photo.exists for photo in photos),
        numbered=sum(number is not None for number in scene.numbers),
        pose_problems=len(_frames([*poses, *sharing])),
        epipolar=epipolar,
        depth=float(look_at_depth(torch.from_numpy(c2w))) if len(c2w) > 1 else 0.0,
        findings=findings,
    )


def _absent(name: str, photos: Sequence[Photo], missing: Sequence[str]) -> Iterator[Finding]:
    """Yield findings if photos are listed but missing, or if fewer than two photos exist."""
    if missing:
        names = listed(missing, 3)
        reason = (
            f"listed images that do not exist: {names}; the numbers of later frames in an "
            "evaluation index are then lower"
        )
        yield Finding(name, reason, "add the files, or remove them from the list")
    there = sum(photo.exists for photo in photos)
    if there < 2:
        reason = f"only {there} photos exist, and a scene needs 2"
        yield Finding(name, reason, "add photos, or remove the scene")


def _unreadable(name: str, error: Exception) -> Finding:
    # messages end with a remedy
    reason, colon, fix = str(error).rpartition(": ")
    if colon and isinstance(error, OSError | ValueError):
        return Finding(name, reason, fix)
    return Finding(name, error_text(error), "copy the files again, or repair their reader")


def _frames(findings: Sequence[Finding]) -> set[int]:
    return {frame for finding in errors_of(findings) for frame, *_ in finding.photos}
