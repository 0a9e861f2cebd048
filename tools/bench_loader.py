"""Whether the loader outruns training, and whether its workers' memory stays where it is.

    python tools/bench_loader.py [--path CHUNKS] [--workers 2] [--samples 10000]

Trains the tiny TokenGS recipe at 256 x 256 on two threads and, in turn, draws its batches from
chunks (synthetic ones, see bench_data.py, without --path). Prints images/s of both, medians of
three rounds, and their ratio; then the own (anonymous) memory of this process and its workers over
many samples. Exit code 1 for a ratio under 5 or memory that grows by more than 5 %.
"""

from __future__ import annotations

import argparse
import statistics
import time
from contextlib import closing
from itertools import islice
from multiprocessing import active_children
from pathlib import Path

import torch
from bench_data import chunks_at

from qgs.composer import Recipe, resolve
from qgs.data.stream import training_batches
from qgs.engine.distributed import make_accelerator
from qgs.engine.objective import Objective
from qgs.engine.optimizer import make_optimizer
from qgs.engine.training import compute_gradients

TINY = Path(__file__).parents[1] / "recipes" / "tiny" / "tokengs.yaml"
ROUNDS, STEPS, BATCHES = 3, 3, 60
RATIO, GROWTH = 5.0, 1.05


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--path")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--samples", type=int, default=10_000)
    options = parser.parse_args()
    with chunks_at(options.path) as path:
        data = {"type": "qgs/chunks", "path": path, "image_size": [256, 256]}
        recipe = resolve({**resolve(TINY).tree, "data": data})
        ratio = measured_ratio(recipe, options.workers)
        growth = measured_growth(recipe, options.workers, options.samples)
    return int(ratio < RATIO or growth > GROWTH)


def measured_ratio(recipe: Recipe, workers: int) -> float:
    """Images/s of the loader over images/s that training consumes."""
    each = recipe.training.batch_size * (recipe.views.inputs + recipe.views.targets)
    train = _trainer(recipe)
    consumed, loaded = [], []
    for _ in range(ROUNDS):
        consumed.append(each * STEPS / _seconds(lambda: [train() for _ in range(STEPS)]))
        stream = training_batches(recipe.build_data(), recipe.views, 2, 0, workers=workers)
        with closing(stream):
            list(islice(stream, 4 * workers + 2))  # processes are up and their queues are empty
            loaded.append(each * BATCHES / _seconds(lambda s=stream: list(islice(s, BATCHES))))
    ratio = statistics.median(loaded) / statistics.median(consumed)
    print(
        f"training consumes {statistics.median(consumed):.1f} images/s, {workers} workers load "
        f"{statistics.median(loaded):.0f} images/s: {ratio:.1f} times as many"
    )
    return ratio


def _trainer(recipe: Recipe):
    torch.set_num_threads(2)
    accelerator = make_accelerator("cpu")
    objective = Objective(recipe.build_model().train(), recipe.build_losses(), 0)
    optimizer = make_optimizer(objective, recipe.build_optimizer())
    with closing(training_batches(recipe.build_data(), recipe.views, 2, 0)) as stream:
        batch = next(stream)

    def step() -> None:
        optimizer.zero_grad()
        compute_gradients(accelerator, objective, recipe.training, [batch])
        optimizer.step()

    step()
    return step


def _seconds(work) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def measured_growth(recipe: Recipe, workers: int, samples: int) -> float:
    """Largest memory after the first fifth of the samples over that at its end."""
    step = max(samples // 10, 1)
    own: list[float] = []
    stream = training_batches(recipe.build_data(), recipe.views, 1, 0, workers=workers)
    with closing(stream):
        for number, _ in zip(range(1, samples + 1), stream, strict=False):
            if number % step == 0:
                own.append(_anonymous())
                print(f"{number:6d} samples: {own[-1]:.0f} MB", flush=True)
    growth = max(own[2:], default=own[-1]) / own[min(1, len(own) - 1)]
    print(f"growth after the first fifth: {100 * (growth - 1):+.1f} %")
    return growth


def _anonymous() -> float:
    """Anonymous resident memory of this process and its workers, MB."""
    total = 0
    for process in ("self", *(str(child.pid) for child in active_children())):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        total += sum(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
    return total / 1000


if __name__ == "__main__":
    raise SystemExit(main())
