"""Kill a training process again and again, many times inside a save, and see that nothing is lost.

    python tools/kill_training.py --kills 50

After each kill -9 the state and the checkpoint must be whole, and the run must go on from there; at
the end its weights must equal, to the bit, those of the same run without a kill. Prints one line
and ends with 1 if anything is lost.
"""

import argparse
import os
import random
import signal
import tempfile
import time
from pathlib import Path

import torch
from rich.console import Console

import qgs
from qgs.composer import Recipe, resolve
from qgs.engine.checkpoint import read_state
from qgs.engine.folder import RunFolder
from qgs.engine.training import train
from qgs.io.files import is_leftover

RECIPE = Path(__file__).parents[1] / "recipes" / "tiny" / "tokengs.yaml"


def recipe_of(width: int, steps: int, save_every: int) -> Recipe:
    """A model whose saves take about as long as its steps."""
    return resolve(
        RECIPE,
        [
            f"model.width={width}",
            "model.queries.count=16",
            "data.image_size=[16, 16]",
            "data.samples=1",
            "training.seconds=null",
            f"training.steps={steps}",
            "optimizer.warmup=2",
            f"training.save_every={save_every}",
        ],
    )


def start(recipe: Recipe, run: Path) -> int:
    """Train in a process of its own; its number."""
    child = os.fork()
    if child:
        return child
    torch.set_num_threads(1)
    train(recipe, run, console=Console(quiet=True), device="cpu", resume=True)
    os._exit(0)


def kill(child: int, run: Path, longest: float) -> bool:
    """Kill `child` at a random moment of its training; False when it had ended by itself."""
    history = run / "history.jsonl"
    before = history.stat().st_mtime_ns if history.exists() else 0
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if history.exists() and history.stat().st_mtime_ns > before:
            time.sleep(random.uniform(0, longest))
            os.kill(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        time.sleep(0.005)
    return False


def saved_step(run: Path) -> int:
    """The step of the state, after checking that state and checkpoint are whole; 0 without."""
    folder = RunFolder(run)
    if folder.checkpoint.exists():
        qgs.load(folder.checkpoint)
    return read_state(folder.state).parts["counters"]["step"] if folder.state.exists() else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--longest", type=float, default=1.0, help="seconds until a kill")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random.seed(options.seed)
    torch.set_num_threads(1)
    recipe = recipe_of(options.width, options.steps, save_every=1)
    with tempfile.TemporaryDirectory() as scratch:
        run = Path(scratch, "run")
        kills = inside = lost = last = 0
        while kills < options.kills and kill(start(recipe, run), run, options.longest):
            kills += 1
            inside += any(map(is_leftover, run.iterdir()))
            step = saved_step(run)
            lost += step < last
            last = step
        os.waitpid(start(recipe, run), 0)
        os.waitpid(start(recipe_of(options.width, options.steps, 0), Path(scratch, "through")), 0)
        ours, theirs = (
            read_state(Path(scratch, name, "state.safetensors")).parts["weights"]
            for name in ("run", "through")
        )
        equal = all(torch.equal(theirs[name], tensor) for name, tensor in ours.items())
    print(
        f"{kills} kills, {inside} inside a save, at step {last} of {options.steps} after the last; "
        f"{lost} times the state was older than before; weights "
        + ("equal" if equal else "DIFFER from")
        + " those without kills"
    )
    return 0 if equal and not lost and kills == options.kills else 1


if __name__ == "__main__":
    raise SystemExit(main())
