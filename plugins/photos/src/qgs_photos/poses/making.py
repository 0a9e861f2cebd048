"""Make folders with the camera poses of photos or a video."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from qgs.files import naming_full_disk, refuse_filled, replacing_entries, write_text
from qgs.wording import counted, listed
from qgs_photos.poses.colmap import run
from qgs_photos.poses.frames import extract
from qgs_photos.poses.job import Job
from qgs_photos.poses.photos import (
    LEAST,
    PosesError,
    Show,
    camera_groups,
    left_out_formats,
    names_of,
    photo_files,
    prepare,
)

RECORD = "poses.json"
FEW = 20
"""Largest number of photos for which all pairs are matched. For more photos, pairs that look alike
are matched."""
MANY = 80
"""Largest number of photos for which pairs that look alike are matched. For more photos, and for
videos, neighbours in the order of names are matched."""


@dataclass(frozen=True)
class Options:
    """Options of `qgs poses`.

    frames: number of frames taken from a video; None lets the camera's motion decide. side: longer
    side in pixels of the photos for COLMAP. matching: "exhaustive" matches all pairs, "sequential"
    neighbours in the order of names; "auto" takes "exhaustive" for up to FEW photos, "sequential"
    for a video and for more than MANY photos, and otherwise matches pairs that look alike.
    features: largest number of features in a photo. threads: number of CPU threads; with 1, equal
    seeds give equal poses.
    """

    frames: int | None = None
    side: int = 1024
    matching: str = "auto"
    features: int = 2048
    threads: int = os.cpu_count() or 1
    seed: int = 0


@dataclass(frozen=True)
class Poses:
    """Result of `make_poses`, with the file names of photos.

    posed: photos with a pose, and how many points in space each shows. without: photos for which no
    pose was found. faulty: photos that cannot be read, with the reason. remarks: sentences for the
    user.
    """

    posed: Mapping[str, int]
    without: Sequence[str]
    faulty: Mapping[str, str]
    remarks: Sequence[str]

    @property
    def summary(self) -> Iterator[str]:
        """Sentences for the user: how many photos have poses, and which have none."""
        total = len(self.posed) + len(self.without)
        yield f"{len(self.posed)} of {counted(total, 'photo')} have poses, in an arbitrary unit"
        yield from self.remarks
        if self.faulty:
            reasons = [f"{name} ({reason})" for name, reason in self.faulty.items()]
            yield f"photos that cannot be read: {listed(reasons, 3)}"
        if self.without:
            yield (
                f"photos without poses: {listed(self.without)}; to get more poses, take photos "
                "between photos with and without poses, so that neighbours share half of what they "
                "show, or try another --matching"
            )


def fingerprint(source: Path) -> dict[str, Any]:
    """Return size (bytes) and modification time (ns) of a video or of each photo, by file name.

    Poses belong to `source` as long as its fingerprint stays the same.
    """
    files = [source] if source.is_file() else photo_files(source)
    stats = map(Path.stat, files)
    times = ([stat.st_size, stat.st_mtime_ns] for stat in stats)
    return dict(zip(names_of(files), times, strict=True))


def make_poses(source: Path, out: Path, options: Options, console: Console) -> Poses:
    """Compute the poses of `source`, photos or a video, and write them to the new folder `out`.

    `out` gets sparse/0 (a COLMAP model), images/ and poses.json. Readers of COLMAP's models can
    open `out`. Raises PosesError if no poses are found, FileExistsError if `out` is not empty, and
    OSError if files cannot be read or written.
    """
    # too few photos raise before anything is written
    record = {"made_by": "qgs poses", "source": fingerprint(source), "options": asdict(options)}
    refuse_filled(out)
    with (
        naming_full_disk(out),
        replacing_entries(out, RECORD) as fresh,
        _bars(console) as show,
    ):
        working = fresh / "working"
        working.mkdir()
        poses = _made(source, fresh, working, options, show)
        shutil.rmtree(working)
        write_text(fresh / RECORD, json.dumps({**record, **asdict(poses)}, indent=1))
    return poses


@contextmanager
def _bars(console: Console) -> Iterator[Show]:
    """Yield a function that shows progress, with one bar for each stage.

    Without a terminal, this function prints only the names of stages.
    """
    tasks = dict[str, TaskID]()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    hidden = not console.is_terminal
    with Progress(*columns, TimeElapsedColumn(), console=console, disable=hidden) as bar:

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage)
                # a log has no bars
                if hidden:
                    console.print(f"{stage} ...", highlight=False, markup=False)
            bar.update(tasks[stage], completed=done, total=total)

        yield show


def _made(source: Path, out: Path, working: Path, options: Options, show: Show) -> Poses:
    small = working / "small"
    models = working / "models"
    for folder in (out / "images", small, models):
        folder.mkdir()
    if source.is_file():
        frames = working / "frames"
        frames.mkdir()
        remarks = extract(source, frames, options.frames, show)
        files = sorted(frames.glob("*.jpg"))
    else:
        files = photo_files(source)
        names = left_out_formats(files[0].parent)
        left_out = f"left out, convert these photos to JPEG: {listed(names, 3)}"
        remarks = [left_out] if names else []
    photos, faulty = prepare(files, out / "images", small, options.side, show)
    if len(photos) < LEAST:
        why = listed((f"{name}: {reason}" for name, reason in faulty.items()), 3, "; ")
        raise PosesError(
            f"{source} has {counted(len(photos), 'photo')} that can be read, but poses need at "
            f"least {LEAST}: replace the damaged photos ({why})"
        )
    matching = options.matching
    if matching == "auto":
        # neighbours in a video share most
        ordered = source.is_file() or len(photos) > MANY
        unordered = "alike" if len(photos) > FEW else "exhaustive"
        matching = "sequential" if ordered else unordered
    job = Job(
        images=str(small),
        database=str(working / "database.db"),
        models=str(models),
        groups=camera_groups(photos),
        sizes={photo.name: photo.size for photo in photos},
        matching=matching,
        features=options.features,
        threads=options.threads,
        seed=options.seed,
    )
    posed, told = run(job, show)
    (out / "sparse").mkdir()
    (models / "best").rename(out / "sparse/0")
    without = [photo.name for photo in photos if photo.name not in posed]
    return Poses(posed, without, faulty, [*remarks, *told])
