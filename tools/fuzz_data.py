"""Attack the readers of data: small data sets of every format, each with one hostile change.

    python tools/fuzz_data.py --count 500 --seed 0
    python tools/fuzz_data.py --seed 0 --only 17

Each case is checked as `qgs data check` does and read as training does; see attack.py. What cannot
be read, the check must call an error.
"""

import logging
import random
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from attack import FaultError, Use, attack, refused
from hostile_data import write_data_set
from qgs_datatools.check import Options, check
from qgs_datatools.sources import sources

from qgs.contracts import ViewsConfig
from qgs.data.paths import opened_path
from qgs.data.recognition import open_for
from qgs.data.stream import SampleStream


def read(folder: str) -> None:
    """Read all frames of all scenes, and draw a sample. Raises what reading raises."""
    source, _ = open_for(folder, (16, 16), None, sources())
    for split in ("train", "test"):
        for scene in source.scenes(split):
            cameras, frames = scene.cameras, range(len(scene))
            every = [scene.images(frames), scene.masks(frames), scene.depths(frames)]
            for tensor in (cameras.c2w, cameras.intrinsics, *every):
                if tensor is not None and not torch.isfinite(tensor).all():
                    raise FaultError(f"{scene.name} is delivered with NaN or infinite numbers")
    scenes = source.scenes("train")
    if all(len(scene) - len(scene.held_out) > 1 for scene in scenes) and len(scenes):
        SampleStream(source, ViewsConfig(inputs=2, targets=1, gap=(1, 3)), 0).batch([0])


def errors_found(folder: Path) -> list[str]:
    """The errors that a check tells."""
    report = check(opened_path(folder), Options(geometry=1, threads=1))
    return [str(finding) for finding in report.findings if finding.severity == "error"]


def judged(folder: Path) -> str:
    """How checking and reading end. Raises what nobody should see."""
    try:
        errors = errors_found(folder)
    except (ValueError, OSError) as error:
        refused(error, str(folder))
        errors = [str(error)]
    if bugs := [line for line in errors if "Traceback" in line or "Error: " in line[7:]]:
        raise FaultError("\n".join(bugs))
    try:
        read(str(folder))
    except (ValueError, OSError) as error:
        said = refused(error, str(folder))
        if not errors:
            raise FaultError(f"the check finds nothing, reading says: {error}") from error
        return f"{said}: {error}"
    return "success" if not errors else f"success, with errors of the check: {errors}"


def prepared(_: Path) -> Callable[[random.Random, Path], tuple[str, Use]]:
    """Cases need nothing in common."""
    np.seterr(all="ignore")
    logging.disable(logging.CRITICAL)

    def case_in(dice: random.Random, folder: Path) -> tuple[str, Use]:
        return write_data_set(folder / "data", dice), partial(judged, folder / "data")

    return case_in


if __name__ == "__main__":
    sys.exit(attack(__doc__, prepared))
