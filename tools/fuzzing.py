"""What the fuzzers share: a process for each case, its limits, damage to files, the command line.

Each fuzzer draws cases from a seed. A case is used in a process of its own and must end in success
or in one of our errors, within SECONDS and BYTES.
"""

import argparse
import math
import multiprocessing
import os
import random
import resource
import shutil
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

SECONDS, BYTES = 60.0, 2 * 10**9
CHARACTERS = 100_000
"""The longest message."""
JUNK: tuple[Any, ...] = (
    10**30, 10**18, -1, 0, 1.5, 1e308, -1e308, 1e-320, math.nan, math.inf, None, True, "", "foo",
    "x" * 100_000, "../" * 50, "images", "/etc/passwd", ".", [], {}, [[]], [None] * 4,
    [0] * 10_000, {"a": {"b": None}},
)  # fmt: skip
"""Values where others belong."""

Use = Callable[[], str]
"""What is done with a case; returns how it ended. Raises what a user must not see."""


class FaultError(Exception):
    """What is wrong with how a case ended."""


def refused(error: BaseException, file: str = "") -> str:
    """ "refused" and the kind of `error`. Raises FaultError for a bad message.

    file: must be named in it.
    """
    text = str(error)
    if file not in text:
        raise FaultError(f"no file is named: {''.join(traceback.format_exception(error))}")
    if len(text) > CHARACTERS:
        raise FaultError(f"a message of {len(text):,} characters")
    return f"refused {type(error).__name__}"


def other_leaf(tree: Any, dice: random.Random) -> str:
    """Replace a leaf or a branch of JSON by junk, or remove it; its path and the junk."""
    holder, path = tree, []
    while True:
        key = dice.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        path.append(key)
        inside = holder[key]
        if not isinstance(inside, dict | list) or not inside or dice.random() < 0.12:
            break
        holder = inside
    holder[key] = value = dice.choice(JUNK)
    if dice.random() < 0.15:
        del holder[key]
    return f"{path} is {str(value)[:30]!r}"


def other_bytes(file: Path, dice: random.Random) -> str:
    """Damage a file, or put another one or none in its place; what was done."""
    data = bytearray(file.read_bytes())
    what = dice.choice(("cut", "flip", "zeros", "random", "more", "web page", "empty", "absent"))
    at = dice.randrange(max(len(data), 1))
    file.unlink()
    if what == "cut":
        del data[at:]
    elif what in ("flip", "zeros"):
        for place in range(at, min(at + dice.choice((1, 8, 64)), len(data))):
            data[place] = 0 if what == "zeros" else data[place] ^ dice.randrange(1, 256)
    elif what == "random":
        data = dice.randbytes(len(data))
    elif what == "more":
        data += bytes(dice.randint(1, 100))
    elif what == "web page":  # a download that failed
        data = b"<!DOCTYPE html><title>404</title>" * 9
    elif what == "empty":
        data = b""
    if what != "absent":
        file.write_bytes(data)
    return f"{what} at {at}"


def in_child(work: Callable[[], object]) -> int:
    """Do `work` in a process of its own, without core files; its number."""
    child = os.fork()
    if child:
        return child
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        work()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def ended(use: Use) -> tuple[str, str]:
    """Do `use` in a process of its own: how it ended, and what is wrong with that ("": nothing)."""
    fork: Any = multiprocessing.get_context("fork")
    reading, writing = fork.Pipe(duplex=False)
    child = fork.Process(target=_answer, args=(use, writing))
    child.start()
    writing.close()
    try:
        if reading.poll(SECONDS):
            return reading.recv()
        child.kill()
        return "", f"hangs for {SECONDS:g} s"
    except EOFError:
        child.join()
        return "", f"ended with {child.exitcode}"
    finally:
        child.join()


def _answer(use: Use, writing: Connection) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        end, fault = use(), ""
    except FaultError as error:
        end, fault = "", str(error)
    except BaseException:  # a user would see a traceback
        end, fault = "", traceback.format_exc()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if not fault and most > BYTES:
        end, fault = "", f"takes {most / 1e6:.0f} MB, then: {end}"
    writing.send((end, fault[-4000:]))


def fuzz(
    description: str | None,
    prepared: Callable[[Path], Callable[[random.Random, Path], tuple[str, Use]]],
) -> int:
    """Run a fuzzer as its command line asks; the exit status.

    prepared: makes what all cases share in a folder, and returns what makes a case of dice and an
    empty folder: a description of the case, and its use.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=500, help="how many cases")
    parser.add_argument("--seed", type=int, default=0, help="a case depends on it and its number")
    parser.add_argument("--only", type=int, help="number of the one case to show and use")
    options = parser.parse_args()
    torch.set_num_threads(1)
    numbers = range(options.count) if options.only is None else [options.only]
    ends, began = Counter[str](), time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        made = prepared(Path(scratch))
        for number in numbers:
            folder = Path(scratch, f"case-{number}")
            folder.mkdir()
            what, use = made(random.Random(f"{options.seed}/{number}"), folder)
            end, fault = ended(use)
            shutil.rmtree(folder)
            ends["WRONG" if fault else end.split(": ")[0]] += 1
            if fault or options.only is not None:
                print(
                    f"--seed {options.seed} --only {number}: {what}\n{fault or end}\n", flush=True
                )
    seconds = time.monotonic() - began
    print(f"{len(numbers)} cases in {seconds:.0f} s: {dict(sorted(ends.items()))}")
    return int(ends["WRONG"] > 0)
