"""Kill trainings, or the processes of a study, at random moments, and check that nothing is lost.

After each kill -9 of a training, its state and checkpoint must be readable and no older than before
the kill. After the training is continued to the end, its state must equal, bit by bit, that of a
run without kills. In a study, workers and the main process are killed; its tables must equal those
of a study without kills.
"""

import json
import random
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from subprocess import Popen
from typing import Any

import psutil
from torch import Tensor

import qgs
from qgs.containers import map_tensors
from qgs.files import is_leftover
from qgs.train.folder import RunFolder, read_state

QGS = str(Path(sys.executable).with_name("qgs"))

# The rate does not collapse on a single sample. Saves take about as long as steps.
TRAINING = """train tiny/tokengs.yaml --out {run} --resume --device cpu --threads 1
--set model.width=192 --set training.steps=150 --set training.save_every={save_every}
--set model.queries.count=16 --set data.image_size=[16,16] --set data.samples=1
--set training.seconds=null --set optimizer.warmup=2 --set optimizer.learning_rate=1e-4
--set evaluation.scenes=1"""

STUDY = """study: 1
title: Killed
base: tiny/locus.yaml
overlay:
  data: {{image_size: [32, 32], scenes: 50, samples: 1}}
  model: {{width: 32, heads: 2, queries: {{count: 32}}, head: {{gaussians_per_query: 4}}}}
  optimizer: {{warmup: 2}}
  training: {{batch_size: 1, save_every: 5}}
  evaluation: {{scenes: 4}}
variants:
  locus:
  free: {{model: {{centers: {{type: qgs/free, z_offset: 0.0}}}}}}
  flat: {{model: {{decoder: {{cross_attention: {{type: qgs/content}}}}}}}}
  tokengs: {{extends: tiny/tokengs.yaml}}
reference: locus
seeds: [0, 1, 2]
budget: {{steps: {steps}}}
differs: [losses.anchor_visibility]
evaluations: {{more: {{views: {{inputs: 3}}}}}}
hypotheses: [free < locus, tokengs@more - tokengs < locus@more - locus]
"""


def started(command: str, log: Path, **values: object) -> Popen[bytes]:
    """Start `qgs COMMAND` as a process that prints to `log`.

    values: replacements for placeholders in the command.
    """
    words = [word.format(**values) for word in command.split()]
    with log.open("ab") as file:
        return Popen([QGS, *words], stdout=file, stderr=file)


def train(run: Path, save_every: int) -> Popen[bytes]:
    return started(TRAINING, run.with_suffix(".log"), run=run, save_every=save_every)


def kill_within(process: Popen[bytes], run: Path) -> bool:
    """Kill a training within a second after its first new step; return False if it ended before."""
    history = run / "history.jsonl"
    before = history.stat() if history.exists() else None
    while process.poll() is None and (not history.exists() or history.stat() == before):
        time.sleep(0.005)
    time.sleep(random.random())
    process.kill()
    return process.wait() == -signal.SIGKILL


def saved_step(run: Path) -> int:
    """Return the step of a run's saved state, or 0 if there is none.

    Raises an error if state or checkpoint cannot be read.
    """
    folder = RunFolder(run)
    if folder.checkpoint.exists():
        qgs.load(folder.checkpoint)
    return read_state(folder.state)[1]["counters"]["step"] if folder.state.exists() else 0


def values_of(run: Path) -> dict[str, Any]:
    """Return all values of a run's saved state by name, except times."""
    values = map_tensors(Tensor.tolist, read_state(run / "state.safetensors")[1])
    del values["counters"]["seconds"]
    return values


def training(folder: Path, count: int) -> int:
    """Kill a training `count` times and continue it; return 0 if nothing was lost, else 1."""
    run = folder / "run"
    steps = [0]
    inside = 0
    while len(steps) <= count and kill_within(train(run, 1), run):
        inside += any(map(is_leftover, run.iterdir()))
        steps.append(saved_step(run))
    codes = [train(run, 1).wait(), train(folder / "quiet", 0).wait()]
    ours = values_of(run)
    quiet = values_of(folder / "quiet")
    differing = [name for name in sorted(ours | quiet) if ours.get(name) != quiet.get(name)]
    print(
        f"{len(steps) - 1} kills, {inside} of them during a save; saved steps after each: {steps}; "
        f"ended with {codes}; values unlike those of a run without kills: {differing}"
    )
    return int(len(steps) <= count or steps != sorted(steps) or any(codes) or differing != [])


def workers_of(queue: Popen[bytes]) -> list[psutil.Process]:
    """Return the training processes that `queue`, the main process of a study, has started."""
    with suppress(psutil.Error):
        return psutil.Process(queue.pid).children()
    return []


def tables_of(out: Path) -> tuple[dict[str, Any], str]:
    """Return the contents of results.json, without times, and of table.md."""
    record = json.loads((out / "results.json").read_text())
    del record["times"]
    return record, (out / "table.md").read_text()


def study(folder: Path, count: int, steps: int = 60) -> int:
    """Kill workers and the main process of a study, `count` times.

    Returns 0 if its tables equal those of a study without kills, else 1.
    """
    (folder / "study.yaml").write_text(STUDY.format(steps=steps))
    command = "study {folder}/study.yaml --out {folder}/{name} --workers 2 --threads 1 --device cpu"

    def queue(name: str) -> Popen[bytes]:
        return started(command, folder / f"{name}.log", folder=folder, name=name)

    process = queue("killed")
    kills: list[str] = []
    while len(kills) < count:
        time.sleep(random.uniform(1.0, 12.0))
        code = process.poll()
        # 1: a run died before its first save; the next queue takes it up again.
        if code in (1, -signal.SIGKILL):
            process = queue("killed")
        elif code is not None:
            break
        else:
            target = random.choice([*workers_of(process), process])
            with suppress(psutil.NoSuchProcess):
                target.kill()
                kills.append("queue" if target is process else "worker")
    for _ in range(5):
        if process.wait() == 0:
            break
        process = queue("killed")
    codes = [process.wait(), queue("quiet").wait()]
    equal = not any(codes) and tables_of(folder / "quiet") == tables_of(folder / "killed")
    print(f"kills: {kills}; ended with {codes}; equal to a study without kills: {equal}")
    return int(not equal or len(kills) < count)
