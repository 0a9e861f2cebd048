"""Kill a study at random moments, workers and queue alike, and compare its table with a quiet one.

    python tools/kill_study.py FOLDER             # ten times SIGKILL; then workers against one
    python tools/kill_study.py FOLDER --kills 3 --steps 20

A study of four variants with three seeds each is run undisturbed by one worker, by two workers,
and by two workers of which one, or the queue itself, is killed again and again. All tables must be
the same in every byte. Exit code 1 where they are not, where fewer kills came than were asked
for, and where two workers took more than --ratio times the wall time of one.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

RECIPES = Path(__file__).parents[1] / "recipes"
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
SAME = ("results.json", "table.csv", "runs.csv", "table.md", "table.tex")
MOST_SECONDS = 3600
RESTARTS = 5  # of queues, one after the other, that end with 1: a run died before its first save


def started(study: Path, out: Path, workers: int) -> subprocess.Popen[bytes]:
    """The queue, with one thread for each run."""
    command = [str(Path(sys.executable).with_name("qgs")), "study", str(study), "--out", str(out)]
    command += ["--workers", str(workers), "--threads", "1", "--device", "cpu"]
    with (out.parent / f"{out.name}.log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log)


def workers_of(out: Path) -> list[int]:
    """Processes that train for the study in `out`."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"qgs_studies.work" in words and str(out).encode() in words:
            found.append(int(folder.name))
    return found


def quiet(study: Path, out: Path, workers: int) -> float:
    """Seconds of an undisturbed study."""
    start = time.monotonic()
    if code := started(study, out, workers).wait(MOST_SECONDS):
        raise RuntimeError(f"the study in {out} ended with {code}; see {out}.log")
    return time.monotonic() - start


def disturbed(study: Path, out: Path, kills: int, rng: random.Random) -> list[str]:
    """Run to the end through so many kills; what was killed."""
    told, queue, restarts = [], started(study, out, 2), 0
    while len(told) < kills and restarts < RESTARTS:
        time.sleep(rng.uniform(1.0, 12.0))
        if queue.poll() is not None:
            if queue.returncode == 0:
                break  # done before all kills came
            queue, restarts = started(study, out, 2), restarts + 1
            continue
        targets = [*workers_of(out), queue.pid]
        target = rng.choice(targets)
        try:
            os.kill(target, signal.SIGKILL)
        except ProcessLookupError:
            continue
        told.append("queue" if target == queue.pid else "worker")
        restarts = 0
        if target == queue.pid:
            queue.wait()
            queue = started(study, out, 2)
    while (code := queue.wait(MOST_SECONDS)) != 0:
        restarts += 1
        if code not in (1, -signal.SIGKILL) or restarts > RESTARTS:
            raise RuntimeError(f"the study in {out} ended with {code}; see {out}.log")
        queue = started(study, out, 2)
    return told


def unlike(one: Path, others: Sequence[Path]) -> list[str]:
    """Files of `others` that are missing or not the same bytes as in `one`."""
    return [
        f"{other.name}/{name}"
        for name in SAME
        for other in others
        if not (other / name).is_file() or (one / name).read_bytes() != (other / name).read_bytes()
    ]


def main() -> int:
    """0 where all is as the head of this file says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--ratio", type=float, default=0.6, help="most; inf where others compute")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.folder.mkdir(parents=True)
    study = given.folder / "study.yaml"
    study.write_text(STUDY.format(recipes=RECIPES, steps=given.steps))
    one, two, killed = (given.folder / name for name in ("one", "two", "killed"))
    told = disturbed(study, killed, given.kills, random.Random(given.seed))
    print(f"killed: {len(told)} ({', '.join(told)})", flush=True)
    seconds = [quiet(study, one, 1), quiet(study, two, 2)]
    ratio = seconds[1] / seconds[0]
    slow = f" of at most {given.ratio}: too much" if ratio > given.ratio else ""
    print(f"one worker {seconds[0]:.0f} s, two {seconds[1]:.0f} s: {ratio:.2f}{slow}")
    bad = unlike(one, (two, killed))
    print(f"differ: {', '.join(bad)}" if bad else f"the same bytes: {', '.join(SAME)}")
    return int(bool(bad or slow) or len(told) < given.kills)


if __name__ == "__main__":
    sys.exit(main())
