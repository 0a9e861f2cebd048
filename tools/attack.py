"""What the tools that attack share: their options, a process for each case, its limits and verdict.

Each tool draws cases from a seed. A case is used in a process of its own and must end in success or
in one error of ours that names the file, within SECONDS of processor time and BYTES of memory.
"""

import argparse
import os
import random
import resource
import select
import shutil
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

SECONDS, BYTES = 5.0, 2_000_000_000
LONGEST = 60.0
"""Seconds by the clock after which a case hangs, on however busy a machine."""
CHARACTERS = 100_000
"""The longest message that is one."""
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
