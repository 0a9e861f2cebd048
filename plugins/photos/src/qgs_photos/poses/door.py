"""What qgs asks for where photos have no cameras, or a video is given: a folder with poses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from qgs_photos.poses.making import (
    Options,
    fingerprint,
    locked,
    make_locked,
    read_record,
    refuse_foreign,
)
from qgs_photos.poses.photos import PosesError


def posed_folder(source: Path) -> Path:
    """The poses of the photos or the video `source`, beside it in NAME_poses; made if need be.

    Raises PosesError where they belong to other photos than are there now, and as `make_poses`.
    """
    held, out = fingerprint(source), beside(source)
    if is_made(source, held, out):
        return out
    with locked(source, out, wait=True):  # of several processes of a training one makes them
        if not is_made(source, held, out):
            refuse_foreign(out)
            _make(source, held, out)
    return out


def is_made(source: Path, held: Mapping[str, Any], out: Path) -> bool:
    """Whether `out` has the poses of `source`. Raises PosesError where they are of other photos.

    held: fingerprint of `source`.
    """
    record = read_record(out)
    if record and record.get("source") != held:
        raise PosesError(
            f"{out} has the poses of what {source} held before: delete it, so that they are made "
            f"anew, or run `qgs poses {source} --out FOLDER` and give that folder"
        )
    return record is not None


def _make(source: Path, held: Mapping[str, Any], out: Path) -> None:
    console = Console(stderr=True)

    def say(text: str) -> None:
        console.print(text, soft_wrap=True, highlight=False, markup=False)

    say(f"{source} has no camera poses: they are made first, once, and kept in {out}")
    for line in make_locked(source, held, out, Options(), console).summary:
        say(line)


def beside(source: Path) -> Path:
    """Where the poses of `source` are kept."""
    whole = source.resolve()
    return whole.with_name(f"{whole.stem if source.is_file() else whole.name}_poses")
