"""How fast chunks are decoded, and that memory does not grow with the samples drawn.

    python tools/bench_data.py [--path CHUNKS] [--samples 10000] [--size 256]

Without --path it writes chunks of synthetic photos (JPEG, 640 x 360) to a temporary folder. Prints
images/s with one and with two threads, both in turn, the median of five rounds, and the resident
memory every thousand samples of two input and two target views: `anonymous` is the program's own,
`mapped` are pages of open chunks, which the system takes back when it needs them. Exit code 1 when
the program's own memory grows by more than 5 % after the first fifth of the samples.
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from qgs_datatools.packing import chunk_entry
from upath import UPath

from qgs.contracts import Scene, ViewsConfig
from qgs.data import ChunksSource
from qgs.data.chunks import ChunksConfig
from qgs.data.scenes import EncodedFrame, EncodedScene
from qgs.data.stream import SampleStream
from qgs.io.files import opened_replacing, write_bytes

CHUNKS, SCENES, FRAMES = 24, 8, 16
ROUNDS, IMAGES, GROWTH = 5, 160, 1.05
PHOTO = (360, 640)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--path")
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--size", type=int, default=256)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with chunks_at(options.path) as path:
        config = ChunksConfig(path=path, image_size=(options.size, options.size))
        source = ChunksSource(config)
        report_speed(source.scenes("train"))
        return report_memory(source, options.samples)


@contextmanager
def chunks_at(path: str | None) -> Iterator[str]:
    """`path` itself, or for None a temporary folder of synthetic chunks."""
    if path is not None:
        yield path
        return
    with TemporaryDirectory() as folder:
        write_synthetic(UPath(folder))
        yield folder


def write_synthetic(folder: UPath) -> None:
    """Chunks of smooth pictures with some noise, which compress about as photos do."""
    index: dict[str, str] = {}
    photos = [_photo(seed) for seed in range(32)]
    for chunk in range(CHUNKS):
        entries = []
        for scene in range(SCENES):
            frames = [_frame(i, photos[(7 * scene + i + chunk) % 32]) for i in range(FRAMES)]
            entries.append(chunk_entry(f"{chunk:03d}_{scene}", frames, ()))
        file = f"{chunk:06d}.torch"
        with opened_replacing(folder / "train" / file) as opened:
            torch.save(entries, opened)
        index |= {entry["key"]: file for entry in entries}
    write_bytes(folder / "train" / "index.json", json.dumps(index).encode())


def _photo(seed: int) -> bytes:
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 256, (18, 32, 3), dtype=np.uint8))
    smooth = np.asarray(coarse.resize((PHOTO[1], PHOTO[0]), Image.Resampling.BICUBIC), np.float32)
    noisy = np.clip(smooth + rng.normal(0, 6, smooth.shape), 0, 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(noisy).save(file, "JPEG", quality=85)
    return file.getvalue()


def _frame(number: int, data: bytes) -> EncodedFrame:
    c2w = np.eye(4)
    c2w[0, 3] = 0.1 * number
    return EncodedFrame(str(number), data, c2w, (500.0, 500.0, 320.0, 180.0), PHOTO)


def report_speed(scenes: Sequence[Scene]) -> None:
    """Images per second with one and two threads, measured in turn."""
    scene = scenes[0]
    assert isinstance(scene, EncodedScene)
    kilobytes = len(scene.encoded(0).data) / 1000
    rates: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(ROUNDS):
        for threads, measured in rates.items():
            measured.append(_rate(scenes, threads))
    for threads, measured in rates.items():
        print(f"{threads} thread(s): {statistics.median(measured):.0f} images/s")
    begin = time.process_time()
    _rate(scenes, 1)
    print(f"{1000 * (time.process_time() - begin) / IMAGES:.2f} ms of processor time an image")
    height, width = scene.encoded(0).size
    print(f"of {width} x {height} pixels and {kilobytes:.0f} kB")


def _rate(scenes: Sequence[Scene], threads: int) -> float:
    each = min(8, len(scenes[0]))
    with ThreadPoolExecutor(threads) as pool:
        begin = time.perf_counter()
        list(pool.map(lambda k: scenes[k % len(scenes)].images(range(each)), range(IMAGES // each)))
        return IMAGES / (time.perf_counter() - begin)


def report_memory(source: ChunksSource, samples: int) -> int:
    """Memory every thousand samples; 1 when it grows."""
    views = ViewsConfig(inputs=2, targets=2, gap=(2, 10), mirror=0.5)
    stream = SampleStream(source, views, seed=0)
    step = max(samples // 10, 1)
    own: list[float] = []
    begin = time.perf_counter()
    for number in range(samples):
        stream.batch([number])
        if (number + 1) % step == 0:
            anonymous, mapped = _memory()
            own.append(anonymous)
            print(f"{number + 1:6d} samples: anonymous {anonymous:.0f} MB, mapped {mapped:.0f} MB")
    rate = 4 * samples / (time.perf_counter() - begin)
    growth = max(own[2:], default=own[-1]) / own[min(1, len(own) - 1)]
    print(f"growth after the first fifth: {100 * (growth - 1):+.1f} %; {rate:.0f} images/s")
    return int(growth > GROWTH)


def _memory() -> tuple[float, float]:
    """Anonymous and file-backed resident memory of this process, MB."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    anonymous, mapped = (int(status[key].split()[0]) / 1000 for key in ("RssAnon", "RssFile"))
    return anonymous, mapped


if __name__ == "__main__":
    raise SystemExit(main())
