"""From photos or a video to a folder with their poses; an interrupted call is taken up again."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from rich.console import Console

from qgs.files import naming_full_disk, write_text
from qgs.wording import counted, listed
from qgs_photos.poses.colmap import REFUSALS, run
from qgs_photos.poses.frames import extract
from qgs_photos.poses.job import Job
from qgs_photos.poses.photos import (
    ColmapError,
    Photo,
    PosesError,
    camera_groups,
    left_out_formats,
    photo_files,
    prepare,
    refuse_hopeless,
)
from qgs_photos.poses.stages import Stages

RECORD = "poses.json"
WORKING = "working"
IMAGES = "images"
SPARSE = "sparse"
EXHAUSTIVE = 80
"""Photos up to which every pair is matched; of more, and of videos, neighbours in time."""


@dataclass(frozen=True)
class Options:
    """Options of `qgs poses`. frames: of a video. side: of the photos for COLMAP, in pixels.

    matching: "auto", "exhaustive" or "sequential". threads: 1 and a seed give the same file again.
    """

    frames: int | None = None
    side: int = 1600
    matching: str = "auto"
    features: int = 4096
    threads: int = os.cpu_count() or 1
    seed: int = 0


@dataclass(frozen=True)
class Poses:
    """Poses of the photos of `folder`. others: photos of further models, each apart from the rest.

    without: names of photos that have none. faulty: those that could not be read, and why. seconds:
    of each stage. error: mean reprojection error in pixels. threads: that made them.
    """

    folder: Path
    posed: Sequence[str]
    without: Sequence[str]
    others: Sequence[Sequence[str]]
    faulty: Mapping[str, str]
    remarks: Sequence[str]
    seconds: Mapping[str, float]
    error: float
    points: int
    threads: int

    @property
    def summary(self) -> Iterator[str]:
        """Sentences on how many photos have poses, and on those that have none."""
        total = len(self.posed) + len(self.without)
        yield f"{len(self.posed)} of {counted(total, 'photo')} have poses"
        yield from self.remarks
        if self.faulty:
            reasons = [f"{name} ({reason})" for name, reason in self.faulty.items()]
            yield f"could not be read: {listed(reasons, 3)}"
        if self.without:
            yield f"without poses: {listed(self.without, 8)}"
        for names in self.others:
            yield (
                f"{counted(len(names), 'photo')} fit each other and none of the rest, so they are "
                f"left out: {listed(names, 4)}"
            )
        if self.without:
            yield (
                "to get more: take photos between those with and those without poses, so that "
                "neighbours share half of what they show; or name another --matching"
            )
        if self.threads > 1:
            yield f"made with {self.threads} threads: another run differs a little"


def fingerprint(source: Path) -> dict[str, Any]:
    """Return what poses are made of: size and time of the video or of every photo, by name."""
    files = [source] if source.is_file() else photo_files(source)
    stats = {file.name: file.stat() for file in files}
    return {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}


def read_record(out: Path) -> Mapping[str, Any] | None:
    """Return what finished poses in `out` were made of; None where there are none."""
    record = _read(out / RECORD)
    return record if isinstance(record, dict) else None


def _read(file: Path) -> Any:
    with suppress(OSError, ValueError):
        return json.loads(file.read_text(encoding="utf-8"))


def make_poses(source: Path, out: Path, options: Options, console: Console) -> Poses:
    """Make poses of the photos or the video `source` in the new folder `out`.

    out: sparse/0 (a COLMAP model) and images, which any reader of COLMAP opens, and poses.json. One
    that an interrupted call with the same options left is finished. Raises PosesError for photos
    without poses, FileExistsError for a folder of something else, and OSError.
    """
    # too few photos raise before anything is written
    held = fingerprint(source)
    with locked(source, out, wait=False):
        return make_locked(source, held, out, options, console)


@contextmanager
def locked(source: Path, out: Path, wait: bool) -> Iterator[None]:
    """Hold the lock of the folder `out`, a hidden file beside it.

    wait: until another process leaves it; else FileExistsError. Raises OSError where the file
    cannot be made.
    """
    file = out.with_name(f".{out.name}.lock")
    lock = FileLock(file, timeout=-1 if wait else 0)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise FileExistsError(
            f"another process makes poses in {out}: wait for it, and repeat the command"
        ) from None
    except OSError as error:
        raise OSError(
            f"{out} cannot be made ({error.strerror}): name another place, as "
            f"`qgs poses {source} --out FOLDER`"
        ) from error
    try:
        yield
    finally:
        # A process that waits for the file takes a new one once this is gone; Windows keeps it.
        with suppress(OSError):
            file.unlink()
        lock.release()


def make_locked(
    source: Path, held: Mapping[str, Any], out: Path, options: Options, console: Console
) -> Poses:
    """Make poses as `make_poses`, for a caller that holds the lock. held: fingerprint of it."""
    _refuse_foreign(out)
    try:
        with naming_full_disk(out / WORKING), Stages(console, out) as stages:
            return _made(source, held, out, options, stages)
    except ColmapError:
        raise
    except PosesError:
        # the same call would end there again
        for part in (WORKING, IMAGES, SPARSE):
            shutil.rmtree(out / part, ignore_errors=True)
        if not any(out.iterdir()):
            out.rmdir()
        raise


def _refuse_foreign(out: Path) -> None:
    """Raise FileExistsError for a folder that this program did not begin."""
    if (out / RECORD).is_file():
        raise FileExistsError(f"{out} has poses already: choose another --out, or delete it")
    begun = (out / WORKING / "begun.json").is_file()
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not begun):
        raise FileExistsError(f"{out} is not empty: choose another --out")


def _made(
    source: Path, held: Mapping[str, Any], out: Path, options: Options, stages: Stages
) -> Poses:
    asked = asdict(options)
    # another number may go on with what is there
    del asked["threads"]
    begun = {"source": held, "options": asked}
    working = out / WORKING
    if _read(working / "begun.json") != begun:
        shutil.rmtree(working, ignore_errors=True)
        shutil.rmtree(out / IMAGES, ignore_errors=True)
        working.mkdir(parents=True)
        write_text(working / "begun.json", json.dumps(begun))
    # each stage leaves files that the next call of an interrupted one finds
    files, remarks = _files(source, working / "frames", options, stages)
    photos, faulty = _prepared(files, out, options, stages)
    refuse_hopeless(photos, faulty, str(source))
    result = _mapped(photos, out, options, source.is_file(), stages)
    posed, *others = apart(result["models"])
    poses = Poses(
        folder=out,
        posed=posed,
        without=[photo.name for photo in photos if photo.name not in {*posed}],
        others=others,
        faulty=faulty,
        remarks=remarks,
        seconds=stages.end(),
        error=result["error"],
        points=result["points"],
        threads=options.threads,
    )
    record = {name: getattr(poses, name) for name in ("seconds", "posed", "without", "error")}
    write_text(out / RECORD, json.dumps({**begun, "made_by": "qgs poses", **record}, indent=1))
    shutil.rmtree(working)
    return poses


def _files(
    source: Path, folder: Path, options: Options, stages: Stages
) -> tuple[list[Path], list[str]]:
    """Return photos and remarks; a video's frames in `folder` stay for an interrupted call."""
    if source.is_dir():
        files = photo_files(source)
        names = left_out_formats(files)
        return files, [f"not read, convert them to JPEG: {listed(names, 3)}"] if names else []
    done = folder / "done.json"
    if not done.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        show = stages.begin("frames of the video", 1)
        write_text(done, json.dumps(extract(source, folder, options.frames, show)))
    return sorted(folder.glob("*.jpg")), _read(done)


def _prepared(
    files: Sequence[Path], out: Path, options: Options, stages: Stages
) -> tuple[list[Photo], dict[str, str]]:
    kept = out / IMAGES
    small = out / WORKING / "small"
    for folder in (kept, small):
        folder.mkdir(exist_ok=True)
    show = stages.begin("photos", len(files))
    return prepare(files, kept, small, options.side, lambda done: show(done, len(files)))


def _mapped(
    photos: Sequence[Photo], out: Path, options: Options, video: bool, stages: Stages
) -> Mapping[str, Any]:
    """Run COLMAP and move its largest model to `out`/sparse/0; return the result of its process.

    Raises PosesError where it refuses or ends.
    """
    models = out / WORKING / "models"
    # models are cheap beside features and matches, which are in the database
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    # neighbours in a video share most; all pairs of 80 photos take a minute
    ordered = video or len(photos) > EXHAUSTIVE
    job = Job(
        images=str(out / WORKING / "small"),
        database=str(out / WORKING / "database.db"),
        models=str(models),
        groups=camera_groups(photos),
        sizes={photo.name: photo.size for photo in photos},
        sequential=ordered if options.matching == "auto" else options.matching == "sequential",
        features=options.features,
        threads=options.threads,
        seed=options.seed,
    )
    run(job, len(photos), stages.show)
    result = json.loads((models / "result.json").read_text(encoding="utf-8"))
    if word := result.get("refused"):
        raise PosesError(REFUSALS[word].format(photos=counted(len(photos), "photo"), **result))
    target = out / SPARSE / "0"
    shutil.rmtree(target, ignore_errors=True)
    target.parent.mkdir(exist_ok=True)
    (models / "best").rename(target)
    return result


def apart(models: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the photos of each model, the largest first, that no model before it has.

    Models with fewer than two of them are left out.
    """
    taken = set[str]()
    kept = list[list[str]]()
    for names in models:
        left = [name for name in names if name not in taken]
        # one photo alone is no group that fits each other
        if len(left) > 1:
            kept.append(left)
        taken.update(names)
    return kept
