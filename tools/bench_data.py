"""How fast chunks are decoded and loaded, and that memory does not grow with the samples drawn.

    python tools/bench_data.py [--path CHUNKS] [--samples 10000] [--size 256] [--workers 2]

Without --path it writes chunks of synthetic photos (JPEG, 640 x 360) to a temporary folder. Prints

- images/s decoded with one and with two threads, both in turn, the median of five rounds;
- images/s that workers load, over those that training the tiny TokenGS recipe on two threads
  consumes, in turn, medians of three rounds;
- the own (anonymous) memory of this process and its workers over many samples of the recipe's
  views, drawn in this process and by workers.

Exit code 1 when the workers load less than five times what training consumes, or memory grows by
more than 5 % after the first fifth of the samples.
"""

import argparse
import io
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from itertools import islice
from multiprocessing import active_children
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from process_memory import megabytes
from qgs_bench.run import in_turn
from qgs_datatools.entries import chunk_entry
from qgs_datatools.packing import opened_replacing, write_bytes
from upath import UPath

from qgs.composer import Recipe, resolve
from qgs.contracts import Scene
from qgs.data.scenes import EncodedFrame, EncodedScene
from qgs.data.stream import training_batches
from qgs.engine.distributed import make_accelerator
from qgs.engine.objective import TrainingPass
from qgs.engine.parameters import make_optimizer
from qgs.engine.training import compute_gradients

TINY = Path(__file__).parents[1] / "recipes" / "tiny" / "tokengs.yaml"
CHUNKS, SCENES, FRAMES = 24, 8, 16
PHOTO = (360, 640)
IMAGES, STEPS, BATCHES = 160, 3, 60
RATIO, GROWTH = 5.0, 1.05


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--path")
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with chunks_at(options.path) as path:
        size = [options.size, options.size]
        data = {"type": "qgs/chunks", "path": path, "image_size": size}
        recipe = resolve({**resolve(TINY).tree, "data": data})
        torch.set_num_threads(1)
        report_decoding(recipe.build_data().scenes("train"))
        ratio = loaded_over_consumed(recipe, options.workers)
        torch.set_num_threads(1)
        growths = [growth(recipe, workers, options.samples) for workers in (0, options.workers)]
    return int(ratio < RATIO or max(growths) > GROWTH)


@contextmanager
def chunks_at(path: str | None) -> Iterator[str]:
    """`path` itself, or for None a temporary folder of smooth pictures with some noise.

    They compress about as photos do.
    """
    if path is not None:
        yield path
        return
    photos = [synthetic_photo(seed) for seed in range(32)]
    index: dict[str, str] = {}
    with TemporaryDirectory() as name:
        folder = UPath(name) / "train"
        for chunk in range(CHUNKS):
            entries = []
            for scene in range(SCENES):
                frames = [_frame(i, photos[(7 * scene + i + chunk) % 32]) for i in range(FRAMES)]
                entries.append(chunk_entry(f"{chunk:03d}_{scene}", frames, ()))
            file = f"{chunk:06d}.torch"
            with opened_replacing(folder / file) as opened:
                torch.save(entries, opened)
            index |= {entry["key"]: file for entry in entries}
        write_bytes(folder / "index.json", json.dumps(index).encode())
        yield name


def synthetic_photo(seed: int) -> bytes:
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


def report_decoding(scenes: Sequence[Scene]) -> None:
    """Images per second with one and two threads, measured in turn."""
    tasks = {threads: partial(_decode, scenes, threads) for threads in (1, 2)}
    columns = in_turn([*tasks.values()], rounds=5, warmup=0)
    for threads, samples in zip(tasks, columns, strict=True):
        print(f"{threads} thread(s): {IMAGES / statistics.median(samples):.0f} images/s")
    begin = time.process_time()
    _decode(scenes, 1)
    print(f"{1000 * (time.process_time() - begin) / IMAGES:.2f} ms of processor time an image")
    assert isinstance(scenes[0], EncodedScene)
    frame = scenes[0].encoded(0)
    print(f"of {frame.size[1]} x {frame.size[0]} pixels and {len(frame.data) / 1000:.0f} kB")


def _decode(scenes: Sequence[Scene], threads: int) -> None:
    each = min(8, len(scenes[0]))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda k: scenes[k % len(scenes)].images(range(each)), range(IMAGES // each)))


def seconds(work: Callable[[], object]) -> float:
    """Wall time of `work`."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def loaded_over_consumed(recipe: Recipe, workers: int) -> float:
    """Images/s of the loader over images/s that training consumes."""
    each = 2 * (recipe.views.inputs + recipe.views.targets)
    train = _training_step(recipe)
    consumed, loaded = [], []
    for _ in range(3):
        consumed.append(each * STEPS / seconds(lambda: [train() for _ in range(STEPS)]))
        stream = training_batches(recipe.build_data(), recipe.views, 2, 0, workers=workers)
        with closing(stream):
            list(islice(stream, 4 * workers + 2))  # processes are up and their queues are empty
            loaded.append(each * BATCHES / seconds(lambda s=stream: list(islice(s, BATCHES))))
    consumes, loads = statistics.median(consumed), statistics.median(loaded)
    print(f"training consumes {consumes:.1f} images/s, {workers} workers load {loads:.0f} images/s")
    print(f"that is {loads / consumes:.1f} times as many")
    return loads / consumes


def _training_step(recipe: Recipe) -> Callable[[], None]:
    torch.set_num_threads(2)
    objective = TrainingPass.of(recipe, recipe.build_model().train())
    optimizer = make_optimizer(objective, recipe.build_optimizer(), recipe.rate_factors(objective))
    accelerator = make_accelerator("cpu")
    with closing(training_batches(recipe.build_data(), recipe.views, 2, 0)) as stream:
        batch = next(stream)

    def step() -> None:
        optimizer.zero_grad()
        compute_gradients(accelerator, objective, recipe.training, [batch])
        optimizer.step()

    step()
    return step


def growth(recipe: Recipe, workers: int, samples: int) -> float:
    """Largest memory after the first fifth of the samples over that at its end."""
    own: list[float] = []
    begin = time.perf_counter()
    with closing(training_batches(recipe.build_data(), recipe.views, 1, 0, workers=workers)) as it:
        for number, _ in zip(range(1, samples + 1), it, strict=False):
            if number % max(samples // 10, 1) == 0:
                children = [child.pid for child in active_children() if child.pid]
                own.append(sum(megabytes("RssAnon", process) for process in ("self", *children)))
                print(f"{number:6d} samples, {workers} workers: {own[-1]:.0f} MB", flush=True)
    images = samples * (recipe.views.inputs + recipe.views.targets)
    rate = images / (time.perf_counter() - begin)
    grown = max(own[2:], default=own[-1]) / own[min(1, len(own) - 1)]
    print(f"growth after the first fifth: {100 * (grown - 1):+.1f} %; {rate:.0f} images/s")
    return grown


if __name__ == "__main__":
    raise SystemExit(main())
