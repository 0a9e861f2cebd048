"""Attack the readers of data: small data sets of every format, each with one hostile change.

    python tools/fuzz_data.py --count 500 --seed 0

Each case is checked as `qgs data check` does and read as training does, in a process of its own,
and must end in success or in one error of ours that names a file of the data set, within 5 seconds
and 2 GB; what cannot be read, the check must call an error. Prints a line for each case that does
not, and ends with 1 if there is any. A case depends on its number alone: --only makes one again.
"""

import argparse
import contextlib
import json
import logging
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hostile_data import write_data_set
from qgs_datatools.check import Options, check
from qgs_datatools.sources import sources

from qgs.contracts import ViewsConfig
from qgs.data.paths import opened_path
from qgs.data.recognition import open_for
from qgs.data.stream import SampleStream

SECONDS, MEGABYTES = 5.0, 2000
_ROOM = 8 * 2**30  # of addresses, beyond those in use


@dataclass(frozen=True)
class Case:
    """What became of a data set. problem: empty where all is well."""

    number: int
    what: str
    seconds: float
    megabytes: float
    problem: str


def read(folder: str) -> None:
    """Read all frames of all scenes, and draw a sample. Raises what reading raises."""
    source, _ = open_for(folder, (16, 16), None, sources())
    for split in ("train", "test"):
        for scene in source.scenes(split):
            cameras, frames = scene.cameras, range(len(scene))
            every = [scene.images(frames), scene.masks(frames), scene.depths(frames)]
            for tensor in (cameras.c2w, cameras.intrinsics, *every):
                if tensor is not None and not torch.isfinite(tensor).all():
                    raise AssertionError(f"{scene.name} is delivered with NaN or infinite numbers")
    scenes = source.scenes("train")
    if all(len(scene) - len(scene.held_out) > 1 for scene in scenes) and len(scenes):
        SampleStream(source, ViewsConfig(inputs=2, targets=1, gap=(1, 3)), 0).batch([0])


def outcome(action: Callable[[], Any], folder: str) -> tuple[str, str]:
    """What an action gives or raises: nothing, `error` or `bug`, and the words."""
    try:
        found = action()
    except (ValueError, OSError) as error:
        ours = folder in str(error) or "scene '" in str(error)
        said = str(error) if ours else f"no file is named: {traceback.format_exc()}"
        return ("error" if ours else "bug"), said
    except BaseException:
        return "bug", traceback.format_exc()
    errors = [str(finding) for finding in getattr(found, "findings", ())]
    errors = [line for line in errors if line.startswith("error")]
    bugs = [line for line in errors if "Traceback" in line or "Error: " in line[7:]]
    return ("bug" if bugs else "error" if errors else ""), "\n".join(bugs or errors)


def attack(folder: Path) -> dict[str, tuple[str, str]]:
    """What checking and reading give."""
    options, name = Options(geometry=1, threads=1), str(folder)
    return {
        "check": outcome(lambda: check(opened_path(folder), options), name),
        "read": outcome(lambda: read(name), name),
    }


def run(number: int, root: Path) -> Case:
    """A case, in a process of its own."""
    folder, told = root / f"case-{number}", root / "told.json"
    with contextlib.suppress(FileNotFoundError):
        told.unlink()
    what = write_data_set(folder, number)
    start = time.perf_counter()
    child = os.fork()
    if not child:
        in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (in_use + _ROOM, in_use + _ROOM))
        told.write_text(json.dumps(attack(folder)))
        os._exit(0)
    while not (ended := os.wait4(child, os.WNOHANG))[0]:
        if time.perf_counter() - start > 3 * SECONDS:
            os.kill(child, signal.SIGKILL)
            ended = os.wait4(child, 0)
            break
        time.sleep(0.005)
    seconds, megabytes = time.perf_counter() - start, ended[2].ru_maxrss * 1.024e-3
    shutil.rmtree(folder)
    shutil.rmtree(root / f"{folder.name}-photos", ignore_errors=True)
    shutil.rmtree(root / "inner-photos", ignore_errors=True)
    problem = ""
    if seconds > 2 * SECONDS or megabytes > MEGABYTES:  # two actions
        problem = f"{seconds:.1f} s, {megabytes:.0f} MB"
    elif not told.is_file():
        problem = f"the process ended with {ended[1]}"
    else:
        results = json.loads(told.read_text())
        bugs = [f"{name}: {said}" for name, (kind, said) in results.items() if kind == "bug"]
        if results["read"][0] and not results["check"][0]:
            bugs.append(f"the check finds nothing, reading says: {results['read'][1]}")
        problem = "\n".join(bugs)
    return Case(number, what, seconds, megabytes, problem)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of the one case to run")
    given = parser.parse_args()
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    logging.disable(logging.CRITICAL)
    first = 1_000_000 * given.seed
    numbers = range(first, first + given.count) if given.only is None else [given.only]
    cases = []
    with tempfile.TemporaryDirectory() as root:
        for number in numbers:
            case = run(number, Path(root))
            cases.append(case)
            if case.problem or given.only is not None:
                print(f"case {number} ({case.what}):\n{case.problem or 'no problem'}", flush=True)
    failed = sum(bool(case.problem) for case in cases)
    print(
        f"{len(cases)} data sets, {failed} with problems; at most "
        f"{max(case.seconds for case in cases):.1f} s and "
        f"{max(case.megabytes for case in cases):.0f} MB for checking and reading"
    )
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
