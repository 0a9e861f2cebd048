"""From photos or a video to a folder with their poses; killed ones are taken up again."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from qgs.files import naming_full_disk, write_text
from qgs.wording import counted, listed
from qgs_photos.poses.colmap import REFUSALS, Job, run
from qgs_photos.poses.frames import extract
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

RECORD, WORKING, IMAGES, SPARSE = "poses.json", "working", "images", "sparse"
EXHAUSTIVE = 80
"""Photos up to which every pair is matched; of more, and of videos, neighbours in time."""
_READING, _FRAMES = "photos", "frames of the video"


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
class Made:
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
            yield f"could not be read: {listed([f'{n} ({r})' for n, r in self.faulty.items()], 3)}"
        if self.without:
            yield f"without poses: {listed(list(self.without), 8)}"
        for names in self.others:
            yield (
                f"{counted(len(names), 'photo')} fit each other and none of the rest, so they are "
                f"left out: {listed(list(names), 4)}"
            )
        if self.without:
            yield (
                "to get more: take photos between those with and those without poses, so that "
                "neighbours share half of what they show; or name another --matching"
            )
        if self.threads > 1:
            yield f"made with {self.threads} threads: another run differs a little"


def fingerprint(source: Path) -> dict[str, Any]:
    """What poses were made of: name, size and time of the video or of every photo."""
    files = [source] if source.is_file() else photo_files(source)
    stats = {file.name: file.stat() for file in files}
    return {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}


def read_record(out: Path) -> Mapping[str, Any] | None:
    """What finished poses in `out` were made of; None where there are none."""
    try:
        record = json.loads((out / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None


def make_poses(source: Path, out: Path, options: Options, console: Console) -> Made:
    """Poses of the photos or the video `source`, in the new folder `out`.

    out: sparse/0 (a COLMAP model) and images, which any reader of COLMAP opens, and poses.json. One
    that an interrupted call with the same options left is finished. Raises PosesError for photos
    without poses, FileExistsError for a folder of something else, and OSError.
    """
    held = fingerprint(source)  # too few photos raise before anything is written
    with locked(source, out, wait=False):
        refuse_foreign(out)
        return make_locked(source, held, out, options, console)


def make_locked(
    source: Path, held: Mapping[str, Any], out: Path, options: Options, console: Console
) -> Made:
    """As `make_poses`, for a caller that holds the lock of `out` and knows that it is its own.

    held: fingerprint of `source`.
    """
    try:
        return _made(source, held, out, options, console)
    except ColmapError:
        raise
    except PosesError:  # the same call would end there again
        for part in (WORKING, IMAGES, SPARSE):
            shutil.rmtree(out / part, ignore_errors=True)
        if not any(out.iterdir()):
            out.rmdir()
        raise


def _made(
    source: Path, held: Mapping[str, Any], out: Path, options: Options, console: Console
) -> Made:
    asked = asdict(options)
    del asked["threads"]  # another number may go on with what is there
    of = {"source": held, "options": asked}
    with naming_full_disk(out / WORKING), Bars(console, out) as bars:
        working = out / WORKING
        if _begun(working) != of:
            shutil.rmtree(working, ignore_errors=True)
            shutil.rmtree(out / IMAGES, ignore_errors=True)
            working.mkdir()
            write_text(working / "begun.json", json.dumps(of))
        remarks = list[str]()
        if source.is_file():
            files, remarks = _frames(source, working / "frames", options, bars)
        else:
            files = photo_files(source)
            if names := left_out_formats(files):
                remarks.append(f"not read, convert them to JPEG: {listed(names, 3)}")
        photos, faulty = _ready(files, out, options, bars)
        refuse_hopeless(photos, faulty, str(source))
        result = _mapped(photos, out, options, source.is_file(), bars)
        posed, *others = apart(_moved(result, out))
        without = [photo.name for photo in photos if photo.name not in {*posed}]
        made = Made(
            folder=out,
            posed=posed,
            without=without,
            others=others,
            faulty=faulty,
            remarks=remarks,
            seconds=dict(bars.ended()),
            error=result["error"],
            points=result["points"],
            threads=options.threads,
        )
        record = {**of, "made_by": "qgs poses", "seconds": made.seconds}
        record |= {"posed": made.posed, "without": made.without, "error": made.error}
        write_text(out / RECORD, json.dumps(record, indent=1))
        shutil.rmtree(working)
    return made


def refuse_foreign(out: Path) -> None:
    """Raise FileExistsError for a folder that this program did not begin."""
    if (out / RECORD).is_file():
        raise FileExistsError(f"{out} has poses already: choose another --out, or delete it")
    if any(out.iterdir()) and not (out / WORKING / "begun.json").is_file():
        raise FileExistsError(f"{out} is not empty: choose another --out")


def _begun(working: Path) -> Any:
    try:
        return json.loads((working / "begun.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


@contextmanager
def locked(source: Path, out: Path, wait: bool) -> Iterator[None]:
    """The folder `out`, made if need be, for this process alone, where the system knows such locks.

    wait: until another process has made the poses of `source` in it; else FileExistsError. Raises
    OSError where it cannot be made or locked.
    """
    while True:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise FileExistsError(f"{out} is a file: choose another --out") from None
        except OSError as error:
            raise OSError(
                f"{out} cannot be made ({error.strerror}): name another place, as "
                f"`qgs poses {source} --out FOLDER`"
            ) from error
        lock = _lock(out, wait)
        # whoever had the lock deletes the folder where there are no poses
        if lock is None or _is(out, lock):
            break
        os.close(lock)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _is(folder: Path, number: int) -> bool:
    """Whether a file descriptor is that of `folder`, and not of a deleted one of its name."""
    try:
        return os.path.samestat(os.fstat(number), folder.stat())
    except FileNotFoundError:
        return False


def _lock(folder: Path, wait: bool) -> int | None:
    """A file descriptor that holds the lock until it is closed; None without such locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(number)
        raise FileExistsError(
            f"another process makes poses in {folder}: wait for it, and repeat the command"
        ) from None
    except OSError:
        pass  # this file system knows no locks
    return number


class Bars:
    """A bar for each stage, and how long each took."""

    def __init__(self, console: Console, out: Path) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        quiet = not console.is_terminal
        self.console, self.out, self.stage, self.began = console, out, "", perf_counter()
        self.seconds: dict[str, float] = {}
        self.bar = Progress(*columns, TimeElapsedColumn(), console=console, disable=quiet)

    def __enter__(self) -> "Bars":
        self.bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._end()
        self.bar.stop()
        if kind is KeyboardInterrupt:
            self.console.print(
                f"stopped; {self.out} keeps what is done, and the same command goes on from there",
                soft_wrap=True, highlight=False, markup=False,
            )  # fmt: skip

    def show(self, stage: str, done: int, total: int) -> None:
        """How far a stage is; a new stage ends the one before."""
        if stage != self.stage:
            self._end()
            self.stage, self.began = stage, perf_counter()
            self.task = self.bar.add_task(stage, total=total)
            if self.bar.disable:
                self.console.print(f"{stage} ...", highlight=False, markup=False)
        self.bar.update(self.task, completed=done, total=total)

    def ended(self) -> Mapping[str, float]:
        """End the last stage; the seconds of all."""
        self._end()
        self.stage = ""
        return self.seconds

    def _end(self) -> None:
        if self.stage:
            taken = self.seconds.get(self.stage, 0.0) + perf_counter() - self.began
            self.seconds[self.stage] = round(taken, 2)


def _frames(
    video: Path, folder: Path, options: Options, bars: Bars
) -> tuple[list[Path], list[str]]:
    """The frames of `video` in `folder`, which stay for an interrupted call, and remarks."""
    done = folder / "done.json"
    if not done.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        bars.show(_FRAMES, 0, 1)
        remarks = extract(
            video, folder, options.frames, lambda count, total: bars.show(_FRAMES, count, total)
        )
        write_text(done, json.dumps(remarks))
    return sorted(folder.glob("*.jpg")), json.loads(done.read_text(encoding="utf-8"))


def _ready(
    files: Sequence[Path], out: Path, options: Options, bars: Bars
) -> tuple[list[Photo], dict[str, str]]:
    kept, small = out / IMAGES, out / WORKING / "small"
    for folder in (kept, small):
        folder.mkdir(exist_ok=True)
    bars.show(_READING, 0, len(files))
    return prepare(
        files, kept, small, options.side, lambda done: bars.show(_READING, done, len(files))
    )


def _mapped(
    photos: Sequence[Photo], out: Path, options: Options, video: bool, bars: Bars
) -> Mapping[str, Any]:
    """The result of the process that runs COLMAP. Raises PosesError where it refuses or ends."""
    models = out / WORKING / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    ordered = video or len(photos) > EXHAUSTIVE
    sequential = ordered if options.matching == "auto" else options.matching == "sequential"
    job = Job(
        images=str(out / WORKING / "small"),
        database=str(out / WORKING / "database.db"),
        models=str(models),
        groups=camera_groups(photos),
        sizes={photo.name: photo.size for photo in photos},
        sequential=sequential,
        features=options.features,
        threads=options.threads,
        seed=options.seed,
    )
    run(job, len(photos), bars.show)
    result = json.loads((models / "result.json").read_text(encoding="utf-8"))
    if word := result.get("refused"):
        raise PosesError(REFUSALS[word].format(photos=counted(len(photos), "photo"), **result))
    return result


def apart(models: Sequence[Sequence[str]]) -> list[list[str]]:
    """The photos of each model, the largest first, that no model before has, where two are left."""
    taken, kept = set[str](), list[list[str]]()
    for names in models:
        left = [name for name in names if name not in taken]
        kept += [left] if len(left) > 1 else []
        taken |= {*names}
    return kept


def _moved(result: Mapping[str, Any], out: Path) -> Sequence[Sequence[str]]:
    """The photos of each model, the largest first, which now is `out`/sparse/0."""
    (out / SPARSE).mkdir(exist_ok=True)
    shutil.rmtree(out / SPARSE / "0", ignore_errors=True)
    (out / WORKING / "models" / "best").rename(out / SPARSE / "0")
    return result["models"]
