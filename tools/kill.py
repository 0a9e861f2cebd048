"""Kill trainings, or the processes of a study, at random moments, and see that nothing is lost.

    python tools/kill.py training --kills 12
    python tools/kill.py study --kills 12

After each kill -9 of a training its state and checkpoint must be whole and no older than before;
continued to the end, its state must equal, to the bit, that of the same run without a kill. A study
of four variants with three seeds loses workers and its queue; its tables must equal
those of an undisturbed one. Prints one line and ends with 1 if anything is lost.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

import qgs
from qgs.files import is_leftover
from qgs.train.folder import RunFolder, read_state

RECIPES = Path(__file__).parents[1] / "recipes"
QGS = str(Path(sys.executable).with_name("qgs"))
MOST_SECONDS = 3600

TRAINING = (
    "model.queries.count=16",
    "data.image_size=[16, 16]",
    "data.samples=1",
    "training.seconds=null",
    "optimizer.warmup=2",
    "optimizer.learning_rate=1e-4",  # one that does not collapse on a single sample
    "evaluation.scenes=1",
)

STUDY = """study: 1
title: Killed
base: {recipes}/tiny/locus.yaml
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
  tokengs: {{extends: {recipes}/tiny/tokengs.yaml}}
reference: locus
seeds: [0, 1, 2]
budget: {{steps: {steps}}}
differs: [losses.anchor_visibility]
evaluations: {{more: {{views: {{inputs: 3}}}}}}
hypotheses: [free < locus, tokengs@more - tokengs < locus@more - locus]
"""


def started(command: list[str], log: Path) -> subprocess.Popen[bytes]:
    """`qgs COMMAND` in a process of its own."""
    with log.open("ab") as file:
        return subprocess.Popen([QGS, *command], stdout=file, stderr=file)


def training(run: Path, width: int, steps: int, save_every: int) -> subprocess.Popen[bytes]:
    """A training whose saves take about as long as its steps."""
    options = (
        f"model.width={width}",
        f"training.steps={steps}",
        f"training.save_every={save_every}",
    )
    settings = [word for option in (*TRAINING, *options) for word in ("--set", option)]
    command = ["train", str(RECIPES / "tiny" / "tokengs.yaml"), "--out", str(run), "--resume"]
    flags = ["--device", "cpu", "--threads", "1"]
    return started([*command, *flags, *settings], run.with_suffix(".log"))


def kill_within(process: subprocess.Popen[bytes], run: Path, longest: float) -> bool:
    """Kill a training at a random moment after its first new step; False if it ended before."""
    history = run / "history.jsonl"
    before = history.stat().st_mtime_ns if history.exists() else 0
    while process.poll() is None:
        if history.exists() and history.stat().st_mtime_ns > before:
            time.sleep(random.uniform(0, longest))
            process.kill()
            return process.wait() == -signal.SIGKILL
        time.sleep(0.005)
    return False


def saved_step(run: Path) -> int:
    """The step of the state, 0 without one; raises where state or checkpoint is not whole."""
    folder = RunFolder(run)
    if folder.checkpoint.exists():
        qgs.load(folder.checkpoint)
    return read_state(folder.state).parts["counters"]["step"] if folder.state.exists() else 0


def differing_values(first: Path, second: Path) -> list[str]:
    """Names of the values that differ in the states of two runs, times aside."""
    ours, theirs = (read_state(run / "state.safetensors").parts for run in (first, second))
    names = {(part, key) for parts in (ours, theirs) for part in parts for key in parts[part]}

    def equal(one: Any, other: Any) -> bool:
        tensors = isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor)
        return torch.equal(one, other) if tensors else bool(one == other)

    return [
        f"{part}/{key}"
        for part, key in sorted(names)
        if key != "seconds" and not equal(ours[part].get(key), theirs[part].get(key))
    ]


def kill_training(folder: Path, options: argparse.Namespace) -> int:
    """Kill trainings; 0 if nothing was lost."""
    run, through = folder / "run", folder / "through"
    kills = inside = lost = last = 0
    size = options.width, options.steps or 400
    while kills < options.kills and kill_within(training(run, *size, 1), run, options.longest):
        kills += 1
        inside += any(map(is_leftover, run.iterdir()))
        step = saved_step(run)
        lost += step < last
        last = step
    codes = [training(run, *size, 1).wait(), training(through, *size, 0).wait()]
    differing = differing_values(run, through)
    print(
        f"{kills} kills, {inside} inside a save, at step {last} of {size[1]} after the last; "
        f"{lost} times the state was older than before; ended with {codes}; "
        + (f"UNLIKE a run without kills: {differing}" if differing else "equal to a quiet run")
    )
    return int(bool(differing or lost or any(codes)) or kills < options.kills)


def workers_of(queue: int) -> list[int]:
    """Processes that train for a queue, by the number of its process."""
    children = Path(f"/proc/{queue}/task/{queue}/children")
    found = []
    for child in children.read_text().split() if children.exists() else ():
        with suppress(OSError):
            # The queue has a process that keeps books of resources, too.
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
    return found


def tables_of(out: Path) -> tuple[dict[str, Any], str]:
    """The results of a study without its times."""
    record = json.loads((out / "results.json").read_text())
    del record["times"]
    return record, (out / "table.md").read_text()


def kill_study(folder: Path, options: argparse.Namespace) -> int:
    """Kill workers and queues of a study; 0 if its tables are those of a quiet one."""
    study = folder / "study.yaml"
    study.write_text(STUDY.format(recipes=RECIPES, steps=options.steps or 60))
    quiet, killed = folder / "quiet", folder / "killed"

    def queue(out: Path) -> subprocess.Popen[bytes]:
        command = ["study", str(study), "--out", str(out), "--workers", "2", "--threads", "1"]
        return started([*command, "--device", "cpu"], out.with_suffix(".log"))

    process, kills = queue(killed), list[str]()
    while len(kills) < options.kills:
        time.sleep(random.uniform(1.0, 12.0))
        # 1: a run died before its first save; the next queue takes it up again.
        if process.poll() in (1, -signal.SIGKILL):
            process = queue(killed)
            continue
        if process.poll() is not None:
            break
        target = random.choice([*workers_of(process.pid), process.pid])
        try:
            os.kill(target, signal.SIGKILL)
        except ProcessLookupError:
            continue
        kills.append("queue" if target == process.pid else "worker")
        process.poll() if target != process.pid else process.wait()
    for _ in range(5):
        if process.wait(MOST_SECONDS) == 0:
            break
        process = queue(killed)
    codes = [process.wait(MOST_SECONDS), queue(quiet).wait(MOST_SECONDS)]
    differing = any(codes) or tables_of(quiet) != tables_of(killed)
    told = "UNLIKE a quiet study" if differing else "equal to a quiet study"
    print(f"{len(kills)} kills ({', '.join(kills)}); ended with {codes}; {told}")
    return int(differing or len(kills) < options.kills)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("training", "study"))
    parser.add_argument("--kills", type=int, default=12)
    parser.add_argument("--steps", type=int, help="of a training (400) or of each run (60)")
    parser.add_argument("--width", type=int, default=256, help="of a training's model")
    parser.add_argument(
        "--longest", type=float, default=1.0, help="seconds until a training's kill"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random.seed(options.seed)
    with tempfile.TemporaryDirectory() as scratch:
        kinds = {"training": kill_training, "study": kill_study}
        return kinds[options.what](Path(scratch), options)


if __name__ == "__main__":
    raise SystemExit(main())
