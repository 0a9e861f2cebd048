"""Runner of fuzz cases. Each has its own process and limits of time and memory."""

import os
import random
import resource
import shutil
import signal
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from random import choice, randrange
from typing import Any

import torch
import yaml

RECIPES = Path(__file__).parents[2] / "recipes"
EVERY = sorted(path.relative_to(RECIPES).as_posix() for path in RECIPES.rglob("*.yaml"))
"""Shipped recipes, by their paths in `RECIPES`."""
SECONDS = 60
BYTES = 2 * 10**9
LONGEST_MESSAGE = 100_000
TABLES = yaml.safe_load(Path(__file__).with_name("tables.yaml").read_text("utf-8"))
JUNK = [*TABLES["junk"], "x" * 100_000, [0] * 10_000]
"""Values of wrong types and extreme sizes, to write in place of valid values."""

Use = Callable[[], str]
"""Function that uses a case and returns the outcome. It raises errors that no user should see."""


class FaultError(Exception):
    """Error for a case with a forbidden outcome."""


def refused(error: BaseException, file: str = "") -> str:
    """Return "refused" and the type of `error`.

    Raises FaultError if the message is too long, or does not contain the name `file`.
    """
    text = str(error)
    if file not in text:
        raise FaultError("the message names no file") from error
    if len(text) > LONGEST_MESSAGE:
        raise FaultError(f"the message is too long: {len(text):,} characters")
    return f"refused {type(error).__name__}"


def other_leaf(tree: Any, junk: Sequence[Any] = JUNK) -> str:
    """Replace a random value in a JSON tree by a junk value, or remove it.

    Returns a description of the change.
    """
    while True:
        key = choice(list(tree) if isinstance(tree, dict) else range(len(tree)))
        inside = tree[key]
        if not isinstance(inside, dict | list) or not inside or random.random() < 0.12:
            break
        tree = inside
    if isinstance(inside, torch.Tensor):
        numbers = inside.float()
        junk = [*junk, inside[:-1], numbers * torch.nan, numbers * 1e30, inside.tolist()]
    tree[key] = value = choice(junk)
    if random.random() < 0.15:
        del tree[key]
    return f"{key} is {str(value)[:30]!r}"


def other_bytes(file: Path) -> str:
    """Damage, replace or delete a file; return a description of the change."""
    data = file.read_bytes()
    at = randrange(len(data) + 1)
    flipped = bytes(byte ^ randrange(1, 256) for byte in data[at : at + 8])
    contents = {
        "cut": data[:at],
        "flip": data[:at] + flipped + data[at + 8 :],
        "zeros": data[:at] + bytes(64) + data[at + 64 :],
        "random": random.randbytes(len(data)),
        "more": data + bytes(9),
        # A download that failed.
        "web page": b"<!DOCTYPE html><title>404</title>" * 9,
        "empty": b"",
        "absent": None,
    }
    what = choice([*contents])
    content = contents[what]
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    return f"{what} at {at}"


def fuzz(kind: Any, scratch: Path, seed: int, count: int, only: int | None = None) -> int:
    """Use `count` random cases and print their outcomes. Return 1 if one was wrong, else 0.

    kind: module with the functions `prepare` and `case_in`. `prepare` writes files that all cases
    share into the folder `scratch`. `case_in` takes this folder and an empty one, and returns a
    description and the use of a random case. only: number of a single case to use.
    """
    kind.prepare(scratch)
    ends = Counter[str]()
    for number in range(count) if only is None else [only]:
        folder = scratch / f"case-{number}"
        folder.mkdir()
        random.seed(f"{seed}/{number}")
        description, use = kind.case_in(scratch, folder)
        end, fault = ended(use)
        shutil.rmtree(folder)
        ends["WRONG" if fault else end.split(": ")[0]] += 1
        if fault or only is not None:
            print(f"--seed {seed} --only {number}: {description}\n{fault or end}\n", flush=True)
    print(f"{ends.total()} cases: {dict(sorted(ends.items()))}")
    return int(ends["WRONG"] > 0)


def ended(use: Use) -> tuple[str, str]:
    """Call `use` in a separate process; return its outcome, and what is wrong with it or ""."""
    with ProcessPoolExecutor(1, get_context("fork")) as pool:
        try:
            end, most = pool.submit(limited, use).result()
        except (Exception, SystemExit):
            return "", traceback.format_exc()[-4000:]
    return end, f"takes {most / 1e6:.0f} MB, then: {end}" if most > BYTES else ""


def limited(use: Use) -> tuple[str, int]:
    """Call `use`; return its outcome and the peak memory of this process in bytes."""
    # The signal ends a process that hangs.
    signal.alarm(SECONDS)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    return use(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
