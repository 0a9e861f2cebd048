"""Kill a process again and again, many times while it writes, and see that nothing is lost.

    python tools/kill_training.py --count 50 --seed 0
    python tools/kill_training.py --what evaluation --count 50
    python tools/kill_training.py --what packing --count 50

After each kill -9 of a training the state and the checkpoint must be whole, and the run must go on
from there; at the end its state must equal, to the bit, that of the same run without a kill.
Evaluations and packings are killed as they open, move or remove one of their files, or a moment
later. They leave whole files alone and the run as it was, and in the end, called again, what they
leave without a kill. Prints one line and ends with 1 if anything is lost.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import torch
from fuzzing import in_child
from qgs_datatools import packing
from qgs_datatools.entries import Encoding
from rich.console import Console

import qgs
from qgs.composer import Recipe, resolve
from qgs.data.paths import opened_path
from qgs.engine.evaluation import evaluate
from qgs.engine.folder import RunFolder, read_state
from qgs.engine.training import train
from qgs.io.checkpoint import CheckpointFile
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
    quiet = Console(quiet=True)
    return in_child(partial(train, recipe, run, console=quiet, device="cpu", resume=True))


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


def kill_training(options: argparse.Namespace) -> int:
    """Kill trainings; 0 if nothing was lost."""
    recipe = recipe_of(options.width, options.steps, save_every=1)
    with tempfile.TemporaryDirectory() as scratch:
        run = Path(scratch, "run")
        kills = inside = lost = last = 0
        while kills < options.count and kill(start(recipe, run), run, options.longest):
            kills += 1
            inside += any(map(is_leftover, run.iterdir()))
            step = saved_step(run)
            lost += step < last
            last = step
        os.waitpid(start(recipe, run), 0)
        os.waitpid(start(recipe_of(options.width, options.steps, 0), Path(scratch, "through")), 0)
        differing = differing_values(*(Path(scratch, name) for name in ("run", "through")))
    print(
        f"{kills} kills, {inside} inside a save, at step {last} of {options.steps} after the last; "
        f"{lost} times the state was older than before; in the end "
        + (
            f"UNLIKE a run without kills: {differing}"
            if differing
            else "equal to one without kills"
        )
    )
    return 0 if not differing and not lost and kills == options.count else 1


def differing_values(first: Path, second: Path) -> list[str]:
    """What differs in the states of two runs, but for the seconds that they took."""
    ours, theirs = (read_state(run / "state.safetensors").parts for run in (first, second))
    names = {(part, key) for parts in (ours, theirs) for part in parts for key in parts[part]}
    return [
        f"{part}/{key}"
        for part, key in sorted(names)
        if key != "seconds" and not same(ours[part].get(key), theirs[part].get(key))
    ]


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal, tensors to the bit."""
    tensors = isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor)
    return torch.equal(one, other) if tensors else bool(one == other)


def evaluate_run(run: Path, out: Path) -> None:
    """As `qgs eval` does."""
    file = run / "checkpoint.safetensors"
    with CheckpointFile(file) as checkpoint:
        model, recipe = checkpoint.model(), checkpoint.recipe
    evaluate(model, recipe, trained_on=model.trained_on).write(out)


def pack_rooms(recipe: Recipe, out: Path) -> None:
    """As `qgs data pack` does, in chunks of a few scenes."""
    source = recipe.build_data()
    splits = packing.own_splits(source)
    packing.pack(
        source, splits, opened_path(str(out)), {}, Encoding(False, None), chunk_bytes=4_000
    )


WRITES = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod")
"""What Python tells of a process that changes files (audit events)."""


def watched(folder: Path, last: int, pause: float) -> Iterator[int]:
    """Kill this process `pause` seconds after it began its `last`-th change of files in `folder`.

    A kernel's timer kills as kill -9 does: nothing of this process runs any more. Gives the numbers
    of the changes that are yet to come.
    """
    numbers = count(1)

    def see(event: str, arguments: tuple[Any, ...]) -> None:
        changes = event in WRITES and str(arguments[0]).startswith(str(folder))
        if changes and (event != "open" or arguments[2] & os.O_ACCMODE) and next(numbers) == last:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, pause)

    sys.addaudithook(see)
    return numbers


def files_of(folder: Path) -> dict[str, bytes]:
    """What `folder` holds, by name, but for what killed processes left."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not is_leftover(path))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def kill_command(options: argparse.Namespace) -> int:
    """Kill evaluations or packings; 0 if nothing was lost."""
    settings = ("data.scenes=12", "data.test_scenes=6", "evaluation.scenes=6")
    recipe = resolve(recipe_of(64, 3, 0).tree, settings)
    with tempfile.TemporaryDirectory() as scratch:
        run, out, through = (Path(scratch, name) for name in ("run", "out", "through"))
        os.waitpid(start(recipe, run), 0)
        before = files_of(run)
        of_kind = {"evaluation": (evaluate_run, run), "packing": (pack_rooms, recipe)}
        command, subject = of_kind[options.what]

        def killed(place: Path, last: int, pause: float) -> int:
            """How the command ends when it is killed so; that it was, as a negative number."""

            def work() -> None:
                numbers = watched(Path(scratch), last, pause)
                command(subject, place)
                Path(scratch, "changes").write_text(str(next(numbers)))

            return os.waitstatus_to_exitcode(os.waitpid(in_child(work), 0)[1])

        assert killed(through, 10**9, 0) == 0
        whole = files_of(through)
        changes = int(Path(scratch, "changes").read_text())
        kills = ended = amid = damaged = 0
        while kills < options.count:
            code = killed(
                out, random.randrange(1, changes), random.choice([1e-6, random.uniform(0, 0.01)])
            )
            if code not in (0, -signal.SIGALRM):
                print(f"called again after {kills} kills, {options.what} ended with {code}")
                return 1
            found = files_of(out)
            kills += code != 0
            ended += code == 0
            left = any(map(is_leftover, out.rglob("*")))
            amid += code != 0 and (left or 0 < len(found.keys() & whole.keys()) < len(whole))
            parts = [name for name in found.keys() & whole.keys() if found[name] != whole[name]]
            damaged += bool(parts) or files_of(run) != before
            if code == 0 and found != whole:
                differing = sorted(n for n in found | whole if found.get(n) != whole.get(n))
                print(f"ended, after {kills} kills, with other files than without: {differing}")
                return 1
            if code == 0:
                shutil.rmtree(out)
        equal = killed(out, 10**9, 0) == 0 and files_of(out) == whole
    print(
        f"{kills} kills of {options.what}, each amid its {changes} changes of files, {amid} left "
        f"some of its files or parts of them, {ended} ends between; "
        f"{damaged} times a file was damaged; in the end "
        + ("equal to" if equal else "UNLIKE")
        + " one without kills"
    )
    return 0 if equal and not damaged else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--what", choices=("training", "evaluation", "packing"), default="training")
    parser.add_argument("--count", type=int, default=50, help="how many kills")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--longest", type=float, default=1.0, help="seconds until a kill")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random.seed(options.seed)
    torch.set_num_threads(1)
    return (kill_training if options.what == "training" else kill_command)(options)


if __name__ == "__main__":
    raise SystemExit(main())
