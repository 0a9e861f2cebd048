"""What the tools that attack share: their options, a process for each case, its limits and verdict.

Each tool draws cases from a seed. A case is used in a process of its own and must end in success or
in one error of ours that names the file, within SECONDS of processor time and BYTES of memory.
"""

import argparse
import math
import os
import random
import resource
import select
import shutil
import signal
import struct
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

SECONDS, BYTES = 5.0, 2_000_000_000
LONGEST = 60.0
"""Seconds by the clock after which a case hangs, on however busy a machine."""
CHARACTERS = 100_000
"""The longest message that is one."""
JUNK: tuple[Any, ...] = (
    10**400, -(10**400), 10**4000, 10**30, 10**18, -1, 0, 1.5, 1e308, -1e308, 1e-320, math.nan,
    math.inf, None, True, "", "foo", "\0", "\ud800", "\x1b[2J", "x" * 100_000, "../" * 50, "images",
    "/etc/passwd", "/dev/zero", ".", [], {}, [[]], [None] * 4, [0] * 10_000, {"a": {"b": None}},
)  # fmt: skip
"""Values where others belong."""
_ROOM = 8 * 2**30  # of addresses, beyond those in use

Use = Callable[[], str]
"""What is done with a case; returns how it ended. Raises what nobody should see."""


class FaultError(Exception):
    """What is wrong with how a case ended."""


@dataclass(frozen=True)
class End:
    """How a process ended. said: what `Use` returned; fault: what is wrong, "" for nothing."""

    said: str
    fault: str
    seconds: float
    megabytes: float


def refused(error: BaseException, file: str = "") -> str:
    """ "refused" and the kind of `error`. Raises FaultError for a bad message.

    file: must be named in it.
    """
    text = str(error)
    if file not in text:
        raise FaultError(f"no file is named: {''.join(traceback.format_exception(error))}")
    if len(text) > CHARACTERS:
        raise FaultError(f"a message of {len(text):,} characters")
    if not text.replace("\n", "").isprintable():
        raise FaultError(f"a message that no terminal prints as it is: {text[:500]!r}")
    return f"refused {type(error).__name__}"


def other_leaf(tree: Any, dice: random.Random) -> str:
    """Put junk in place of a leaf or a branch of JSON, or remove it; its path, and what it is."""
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
    """Damage the bytes of a file, or put something else in its place; what was done."""
    data = bytearray(file.read_bytes())
    what = dice.choice(("cut", "flip", "zeros", "junk", "random", "count", "place", "NaN", "more"))
    at = dice.randrange(max(len(data), 1))
    if what == "cut":
        del data[at:]
    elif what in ("flip", "zeros"):
        for place in range(at, min(at + dice.choice((1, 8, 64)), len(data))):
            data[place] = 0 if what == "zeros" else data[place] ^ dice.randrange(1, 256)
    elif what == "count":
        data[:8] = struct.pack("<Q", dice.choice((0, len(data), 10**8, 2**40, 2**63, 2**64 - 1)))
    elif what == "NaN":  # of whatever numbers lie there
        data[at : at + 8] = struct.pack("<d", dice.choice((math.nan, 1e308, -1.0, 0.0)))
    elif what == "more":
        data += bytes(dice.randint(1, 100))
    elif what == "junk":
        starts = (
            b"PK\x03\x04",
            b"\x80\x02.",
            b"\x1f\x8b\x08",
            b"<!DOCTYPE html>",
            b"{}",
            b"\xff" * 9,
        )
        data = dice.choice((b"", *starts)) + dice.choice((b"", data))
    elif what == "random":
        data = dice.randbytes(len(data))
    else:
        return other_place(file, dice)
    file.write_bytes(data)
    return f"{what} at {at}"


def other_place(file: Path, dice: random.Random) -> str:
    """Put something else in place of a file; what."""
    file.unlink()
    what = dice.choice(
        ("pipe", "folder", file.name, "/dev/zero", "/dev/null", "nowhere", "1 TB", "")
    )
    if what == "pipe":
        os.mkfifo(file)
    elif what == "folder":
        file.mkdir()
    elif what == "1 TB":
        with file.open("wb") as opened:
            opened.truncate(10**12)
    elif what:
        file.symlink_to(what)
    return f"is {what or 'absent'}"


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


def ended(use: Use) -> End:
    """Do `use` in a process of its own, within the limits."""
    reading, writing = os.pipe()

    def told() -> None:
        in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (in_use + _ROOM, in_use + _ROOM))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        try:
            answer = "+" + use()
        except FaultError as fault:
            answer = f"-{fault}"
        except BaseException:  # whatever a user would see as a traceback
            answer = "-" + traceback.format_exc()
        if len(answer) > 4000:
            answer = answer[:1500] + " ... " + answer[-2000:]
        os.write(writing, answer.encode(errors="replace"))

    child = in_child(told)
    os.close(writing)
    ready, _, _ = select.select([reading], [], [], LONGEST)
    answer = os.read(reading, 60_000).decode() if ready else f"-hangs for {LONGEST:g} s"
    os.close(reading)
    if not ready:
        os.kill(child, signal.SIGKILL)
    _, status, used = os.wait4(child, 0)
    answer = answer or f"-ended with {os.waitstatus_to_exitcode(status)}"
    said, fault = (answer[1:], "") if answer[0] == "+" else ("", answer[1:])
    seconds, megabytes = used.ru_utime + used.ru_stime, used.ru_maxrss * 1.024e-3
    if not fault and (seconds > SECONDS or megabytes > BYTES / 1e6):
        fault = f"takes {seconds:.1f} s and {megabytes:.0f} MB, then: {said}"
    return End(said, fault, seconds, megabytes)


def attack(
    description: str | None,
    prepared: Callable[[Path], Callable[[random.Random, Path], tuple[str, Use]]],
) -> int:
    """Run a tool as its command line says; 0 if nothing is wrong.

    prepared: makes what all cases share in a folder, and returns what makes a case of dice and an
    empty folder: the case in words, and its use.
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
    longest = most = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        made = prepared(Path(scratch))
        for number in numbers:
            folder = Path(scratch, f"case-{number}")
            folder.mkdir()
            what, use = made(random.Random(f"{options.seed}/{number}"), folder)
            end = ended(use)
            shutil.rmtree(folder)
            longest, most = max(longest, end.seconds), max(most, end.megabytes)
            ends["WRONG" if end.fault else end.said.split(": ")[0]] += 1
            if end.fault or options.only is not None:
                print(f"--seed {options.seed} --only {number}: {what}", flush=True)
                print(f"{end.fault or end.said}\n", flush=True)
    print(
        f"{len(numbers)} cases, {ends['WRONG']} wrong, at most {longest:.1f} s of processor time "
        f"and {most:.0f} MB, in {time.monotonic() - began:.0f} s: {dict(sorted(ends.items()))}"
    )
    return 1 if ends["WRONG"] else 0
