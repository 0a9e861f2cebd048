"""How scenes are read from a remote store that is slow and fails, by many processes.

    python tools/bench_store.py [--kind chunks|photos] [--readers 1 4 16 64] [--faults] [--seed 0]

Writes scenes of synthetic photos (JPEG, 640 x 360) as chunks or as folders of photos to a temporary
folder and serves them through fsspec as `slow://`: every request waits 50 ms, all readers share one
link of `--bandwidth` MB/s, and with --faults requests fail: errors as of a busy server, connections
that break, time-outs, answers that stop early, and reads that never end. Training batches are then
drawn by so many worker processes (`qgs.data.stream.training_batches`; forked here, not spawned as
in training, so that 64 fit into a few gigabytes), and of each number is printed

- images/s, from the first batch on, and the longest that training would have waited for a batch;
- what the store was asked for: requests and bytes, for each image that training got;
- memory and open files of a worker, at a third of the batches and at the end;
- whether the batches are, bit for bit and in order, those that one process reads of local files.

Each reader draws its faults from `--seed` and its own index; a reader of photos has eight requests
at a time, so which of them fails still varies. `--patience` and `--pauses` replace
PATIENCE and PAUSES of `qgs.data.paths`, with which a run would take hours. Exit code 1 when a batch
is wrong or missing, or memory or open files grow.
"""

import argparse
import fcntl
import hashlib
import json
import os
import random
import statistics
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from copy import copy
from dataclasses import asdict, dataclass
from itertools import islice
from multiprocessing import active_children
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import fsspec
import torch
from bench_data import PHOTO, chunks_at, synthetic_photo
from fsspec.implementations.local import LocalFileSystem
from process_memory import megabytes
from torch.utils.data import DataLoader, get_worker_info

from qgs.composer import Recipe, resolve
from qgs.data import paths, stream
from qgs.data.sampling import Batch

TINY = Path(__file__).parents[1] / "recipes" / "tiny" / "tokengs.yaml"
SETTINGS = "QGS_BENCH_STORE"
GROWTH, MORE_FILES = 1.15, 8
FAULTS = {"busy": 0.02, "broken": 0.01, "timeout": 0.005, "short": 0.02, "endless": 0.001}
PHOTO_SCENES, PHOTO_FRAMES = 48, 16


@dataclass(frozen=True)
class Settings:
    """Of the store, for all processes. folder: of its log and link. bandwidth: bytes/s of all."""

    folder: str
    latency: float
    bandwidth: float
    faults: bool
    patience: float
    pauses: tuple[float, ...]
    seed: int


class SlowStore(LocalFileSystem):
    """Local files behind `slow://`, through a slow link that all processes share, with faults."""

    protocol = "slow"
    cachable = False

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        settings = json.loads(os.environ[SETTINGS])
        self._settings = Settings(**settings)
        self._randoms: dict[int, random.Random] = {}

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        text = os.fspath(path) if not isinstance(path, str) else path
        return LocalFileSystem._strip_protocol(text.removeprefix("slow://"))

    def cat_file(
        self, path: str, start: int | None = None, end: int | None = None, **options: Any
    ) -> bytes:
        """Bytes of a file; fewer than there are, an error, or nothing ever, by chance."""
        content = super().cat_file(path, start, end, **options)
        assert isinstance(content, bytes)
        drawn = self._random()
        kind = self._chance(drawn.random())
        if kind == "short":
            content = content[: drawn.randrange(1, max(2, len(content)))]
        self._wait(kind, len(content))
        return content

    def info(self, path: Any, **options: Any) -> dict[str, Any]:
        """Size and kind of a path, after the store's latency."""
        if not isinstance(path, os.DirEntry):  # as `ls` asks
            self._wait("info", 0)
        return super().info(path, **options)

    def ls(self, path: str, detail: bool = False, **options: Any) -> Any:
        """What a folder holds, after the store's latency."""
        self._wait("list", 0)
        return super().ls(path, detail, **options)

    def _random(self) -> random.Random:
        """Of the seed and the reader's index; -1 for the process that trains."""
        worker = get_worker_info()
        reader = -1 if worker is None else worker.id
        return self._randoms.setdefault(reader, random.Random(f"{self._settings.seed} {reader}"))

    def _chance(self, at: float) -> str:
        for kind, share in FAULTS.items() if self._settings.faults else ():
            at -= share
            if at < 0:
                return kind
        return "read"

    def _wait(self, kind: str, size: int) -> None:
        self._log(kind, size)
        if kind == "endless":
            time.sleep(24 * 3600)
        time.sleep(self._settings.latency)
        if kind == "timeout":
            time.sleep(2)
            raise TimeoutError("the store did not answer within 2 s")
        if kind == "busy":
            raise OSError("503 Slow Down: reduce your request rate")
        if kind == "broken":
            raise ConnectionResetError("connection reset by peer")
        self._transfer(size / self._settings.bandwidth)

    def _transfer(self, seconds: float) -> None:
        """Wait for the turn on the link, whose file says when it is free, and for `seconds`."""
        with (Path(self._settings.folder) / "link").open("r+") as link:
            fcntl.flock(link, fcntl.LOCK_EX)
            end = max(time.time(), float(link.read() or 0)) + seconds
            link.seek(0)
            link.write(f"{end:.6f}")
            link.flush()
            fcntl.flock(link, fcntl.LOCK_UN)
        time.sleep(max(0.0, end - time.time()))

    def _log(self, kind: str, size: int) -> None:
        log = os.open(Path(self._settings.folder) / "log", os.O_WRONLY | os.O_APPEND)
        os.write(log, f"{kind} {size}\n".encode())
        os.close(log)


fsspec.register_implementation("slow", SlowStore, clobber=True)


def forked(dataset: Any, **options: Any) -> DataLoader[Any]:
    """A DataLoader whose workers are forked, but open the data themselves as spawned ones do."""
    options |= {"multiprocessing_context": "fork", "generator": torch.Generator()}
    return DataLoader(copy(dataset), **options)


def main() -> int:
    """Measure each number of readers and say whether all held."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kind", choices=("chunks", "photos"), default="chunks")
    parser.add_argument("--readers", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--batches", type=int, default=150)
    parser.add_argument("--latency", type=float, default=0.05)
    parser.add_argument("--bandwidth", type=float, default=250.0, help="MB/s, of all readers")
    parser.add_argument("--faults", action="store_true")
    parser.add_argument(
        "--seed", type=int, default=0, help="of the faults, with each reader's index"
    )
    parser.add_argument("--patience", type=float, default=10.0)
    parser.add_argument("--pauses", type=float, nargs="+", default=[0.25, 1.0, 4.0, 16.0])
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of UPath, which does not know `slow`, and of many workers
    with stored(options.kind) as folder, TemporaryDirectory() as own:
        settings = Settings(
            own,
            options.latency,
            options.bandwidth * 1e6,
            options.faults,
            options.patience,
            tuple(options.pauses),
            options.seed,
        )
        wanted = [fingerprint(b) for b in batches(options.kind, folder, 0, options.batches)]
        held = True
        for readers in options.readers:
            held &= measure(options, f"slow://{folder}", readers, settings, wanted)
    return int(not held)


@contextmanager
def stored(kind: str) -> Iterator[str]:
    """A temporary folder of scenes as chunks or as folders of photos."""
    if kind == "chunks":
        with chunks_at(None) as folder:
            yield folder
        return
    with TemporaryDirectory() as folder:
        photos = [synthetic_photo(seed) for seed in range(32)]
        for scene in range(PHOTO_SCENES):
            images = Path(folder) / f"scene_{scene:02d}" / "images"
            images.mkdir(parents=True)
            frames = []
            for number in range(PHOTO_FRAMES):
                (images / f"{number:03d}.jpg").write_bytes(photos[(scene + number) % 32])
                pose = [[1, 0, 0, 0.1 * number], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
                frames.append({"file_path": f"images/{number:03d}.jpg", "transform_matrix": pose})
            lens = {"fl_x": 500, "fl_y": 500, "cx": 320, "cy": 180, "w": PHOTO[1], "h": PHOTO[0]}
            listing = json.dumps({"camera_model": "PINHOLE", **lens, "frames": frames})
            (images.parent / "transforms.json").write_text(listing)
        yield folder


def recipe_of(kind: str, path: str) -> Recipe:
    """Of 8 images of 256 x 256 a sample, as the published trainings have."""
    data: dict[str, Any] = {"type": f"qgs/{kind}", "path": path, "image_size": [256, 256]}
    data |= {"holdout": 0}
    changes = ["views.inputs=4", "views.targets=4", "views.gap=[8, 14]"]
    return resolve({**resolve(TINY).tree, "data": data}, changes)


def batches(kind: str, path: str, readers: int, count: int) -> Iterator[Batch]:
    """The first batches, of two scenes each."""
    recipe = recipe_of(kind, path)
    source = recipe.build_data()
    made = stream.training_batches(source, recipe.views, 2, 0, workers=readers)
    with patch.object(stream, "DataLoader", forked), closing(made):
        yield from islice(made, count)


def fingerprint(batch: Batch) -> str:
    """What tells a batch from others: scenes, pixels and cameras."""
    digest = hashlib.sha256(repr((batch.scenes, batch.left_out)).encode())
    for views in (batch.inputs, batch.targets):
        digest.update(views.images.numpy().tobytes() + views.cameras.c2w.numpy().tobytes())
    return digest.hexdigest()


def measure(
    options: argparse.Namespace,
    path: str,
    readers: int,
    settings: Settings,
    wanted: Sequence[str],
) -> bool:
    """Print what a number of readers reach; whether all held."""
    os.environ[SETTINGS] = json.dumps(asdict(settings))
    paths.PATIENCE, paths.PAUSES = settings.patience, settings.pauses
    own = Path(settings.folder)
    for name in ("link", "log"):
        (own / name).write_text("")
    begin, waited, seen, resources = time.perf_counter(), [], [], []
    try:
        for number, batch in enumerate(batches(options.kind, path, readers, options.batches)):
            waited.append(time.perf_counter() - begin)
            seen.append(fingerprint(batch))
            if number in (options.batches // 3, options.batches - 1):
                resources.append(of_workers())
            begin = time.perf_counter()
    except Exception as error:
        print(f"{readers} readers end after {len(seen)} batches: {error}")
    if not resources:
        return False
    report(readers, waited, own / "log", resources, seen == list(wanted))
    (memory, files), (memory_later, files_later) = resources[0], resources[-1]
    grown = memory_later > GROWTH * memory or files_later > files + MORE_FILES
    return seen == list(wanted) and not grown


def of_workers() -> tuple[float, float]:
    """Own memory in MB and open files of a worker, the mean of all."""
    pids = [child.pid for child in active_children() if child.pid] or [os.getpid()]
    files = [len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid in pids]
    return statistics.mean(megabytes("RssAnon", pid) for pid in pids), statistics.mean(files)


def report(
    readers: int,
    waited: Sequence[float],
    log: Path,
    resources: Sequence[tuple[float, float]],
    same: bool,
) -> None:
    """Print a row."""
    asked = Counter[str]()
    size = 0
    for line in log.read_text().splitlines():
        kind, _, count = line.partition(" ")
        asked[kind] += 1
        size += int(count)
    images = 16 * len(waited)
    rate = 16 * (len(waited) - 1) / max(sum(waited[1:]), 1e-9)
    faults = {kind: asked[kind] for kind in FAULTS if asked[kind]}
    print(
        f"{readers} readers: {rate:.0f} images/s, first batch after {waited[0]:.1f} s, then at "
        f"most {max(waited[1:]):.1f} s; {asked.total() / images:.2f} requests and "
        f"{size / images / 1e6:.3f} MB an image ({dict(asked)}); faults {faults}; memory and files "
        f"{[(round(a), round(b)) for a, b in resources]}; {'as' if same else 'NOT AS'} locally",
        flush=True,
    )


if __name__ == "__main__":
    raise SystemExit(main())
