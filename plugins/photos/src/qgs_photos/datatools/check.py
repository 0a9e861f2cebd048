"""All scenes of a data set, whatever its format, and its evaluation indices."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from upath import UPath

from qgs.data.photos import read_listing, readers
from qgs.wording import counted, listed
from qgs_photos.datatools.cameras import camera_findings, sharing_findings
from qgs_photos.datatools.candidates import Candidate, Photo
from qgs_photos.datatools.chunks import chunk_folders
from qgs_photos.datatools.decoding import DecodedScene, decode, error_text
from qgs_photos.datatools.files import file_findings, size_findings
from qgs_photos.datatools.findings import Finding, errors_of, merged
from qgs_photos.datatools.folders import dl3dv_scenes, photo_folders
from qgs_photos.datatools.geometry import TOO_FEW, geometry_findings, judge_scene
from qgs_photos.datatools.indices import Held, found_indices, index_findings
from qgs_photos.datatools.masks import matched_findings, picture_findings
from qgs_photos.datatools.report import CheckReport, SceneReport
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
    _refuse_unknown(options.format)
    # a listing stands for its folder
    if path.is_file() and path.suffix in (".json", ".npy"):
        path = path.parent
    candidates, general, reported = _candidates(path, options)
    if not candidates and not general:
        # raises: what is missing for a photo folder
        read_listing(path, _photo_format(options))
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
    if partly := sum(bool(scene.geometry and scene.geometry.left_out) for scene in scenes):
        notes.append(
            f"in {counted(partly, 'scene')} only some of the photos were matched "
            "with others; a lower --geometry judges fewer scenes by more of theirs"
        )
    return CheckReport(
        path=str(path),
        scenes=scenes,
        general=general,
        indices=summaries,
        judged=len(judged),
        notes=[*left_out(options.format), *notes],
    )


def _refuse_unknown(format: str) -> None:
    of_plugins = [kind for kind in sources(format) if kind.partition("/")[0] not in OF_FILES]
    known = ["auto", *readers(), "dl3dv", "chunks", *of_plugins]
    if format not in known:
        usable = f"{', '.join(known)}, or PLUGIN/NAME of a source that reads a path"
        raise ValueError(f"there is no format {format!r}: use one of {usable}")


def _candidates(path: UPath, options: Options) -> tuple[list[Candidate], list[Finding], set[str]]:
    """Return scenes, findings about files, and scenes that such findings may be about."""
    kind = options.format
    if kind == "auto":
        is_chunk = path.is_file() and path.suffix == ".torch"
        kind = "chunks" if is_chunk else kind_of(path)
    if kind == "chunks":
        if options.images is not None:
            raise ValueError("chunks hold their images: leave --images out")
        folders = chunk_folders(path)
        candidates = [candidate for folder in folders for candidate in folder.candidates]
        findings = [finding for folder in folders for finding in folder.findings]
        return candidates, findings, {key for folder in folders for key in folder.index}
    if kind == "dl3dv":
        items = list[Candidate | Finding](dl3dv_scenes(path, options.images))
    elif "/" in kind:
        items = list[Candidate | Finding](source_scenes(kind, path, options.images))
    else:
        items = list(photo_folders(path, _photo_format(options), options.images))
    candidates = [item for item in items if isinstance(item, Candidate)]
    return candidates, [item for item in items if isinstance(item, Finding)], set()


def _photo_format(options: Options) -> str:
    return options.format if options.format in readers() else "auto"


def _scenes_to_judge(count: int, options: Options) -> tuple[set[int], list[str]]:
    """Return the scenes whose poses are matched with photos, and a note on the others."""
    if options.headers_only:
        return set(), ["quick: only headers of images were read, and no pose was judged by photos"]
    if not options.geometry:
        return set(), ["no pose was judged by photos (--geometry 0)"]
    # over the whole data set: faults come in batches of scenes
    spread = np.linspace(0, max(count - 1, 0), min(options.geometry, count)).round()
    places = {int(place) for place in spread}
    left = f"poses were judged by photos in {len(places)} of {count} scenes; --geometry {count}"
    return places, [f"{left} judges all"] if len(places) < count else []


def check_scene(candidate: Candidate, options: Options, most_photos: int) -> SceneReport:
    """Check one scene; every fault becomes a finding. Raises as `check`.

    most_photos: that are matched with each other, to judge its cameras.
    """
    report = SceneReport(candidate.name, candidate.scene, candidate.kind, candidate.split)
    try:
        photos = candidate.photos()
        missing = candidate.missing()
    except Exception as error:
        # whatever a reader raises; the other scenes go on
        return replace(report, findings=[_unreadable(candidate.name, error)])
    absent = list(_absent(candidate.name, photos, missing))
    if not photos:
        return replace(report, findings=absent)
    with ThreadPoolExecutor(options.threads) as pool:
        decoded = list(pool.map(partial(decode, headers_only=options.headers_only), photos))
    scene = DecodedScene(candidate.name, photos, decoded)
    sizes = list(size_findings(scene))
    # a wrong size makes intrinsics look wrong, a wrong pose says nothing about shared ones
    poses, others = camera_findings(scene, _frames(sizes))
    faulty_poses = _frames(poses)
    placed = [
        frame
        for frame, photo in enumerate(photos)
        if frame not in faulty_poses and np.isfinite(photo.listed.c2w).all()
    ]
    sharing = list(sharing_findings(scene, placed, float32=candidate.kind == "chunks"))
    files = file_findings(scene, _listing(candidate.kind))
    pictures = picture_findings(scene)
    findings = merged([*absent, *files, *sizes, *poses, *others, *sharing, *pictures])
    geometry = None
    if most_photos:
        faulty = _frames([*sizes, *others, *sharing])
        usable = [f for f in placed if f not in faulty and decoded[f].size is not None]
        geometry = judge_scene(scene, usable, most_photos)
        # what else is wrong says already why nothing could be judged
        explained = errors_of(findings) and geometry.unjudged not in ("", TOO_FEW)
        if not explained:
            findings += geometry_findings(scene, geometry)
        findings += matched_findings(scene, geometry.pairs)
    drawn = [frame for frame in placed if scene.numbers[frame] is not None]
    c2w = [photos[frame].listed.c2w[:3] for frame in drawn]
    return replace(
        report,
        listed=len(photos) + len(missing),
        decodable=sum(result.size is not None for result in decoded),
        missing=len(missing) + sum(not photo.exists for photo in photos),
        numbered=sum(number is not None for number in scene.numbers),
        pose_problems=len(_frames([*poses, *sharing])),
        frames=tuple(scene.numbers[frame] for frame in drawn),
        c2w=np.array(c2w, np.float32).reshape(-1, 3, 4),
        geometry=geometry,
        findings=findings,
    )


def _absent(name: str, photos: Sequence[Photo], missing: Sequence[str]) -> Iterator[Finding]:
    """Yield what is wrong with the number of photos."""
    if missing:
        names = listed(missing, 3)
        reason = f"listed images that do not exist: {names}; later frames move up in an index"
        yield Finding(name, reason, "add the files, or take them out of what lists them")
    elif not photos:
        yield Finding(name, "no photos are listed", "export the scene again")
    if photos and (there := sum(photo.exists for photo in photos)) < 2:
        reason = f"{there} photos are there, and a scene needs 2"
        yield Finding(name, reason, "add photos, or take the scene out")


def _unreadable(name: str, error: Exception) -> Finding:
    # messages end with a remedy
    reason, colon, fix = str(error).rpartition(": ")
    if colon and isinstance(error, OSError | ValueError):
        return Finding(name, reason, fix)
    return Finding(name, error_text(error), "get the files again, or mend what reads them")


def _listing(kind: str) -> str:
    """Return what messages call the file that lists the photos of a format."""
    known = {"dl3dv": "transforms.json", "chunks": "the chunk"}
    known |= {name: reader.listing for name, reader in readers().items()}
    return known.get(kind, "the data set")


def _frames(findings: Sequence[Finding]) -> set[int]:
    return {frame for finding in errors_of(findings) for frame in finding.frames}
