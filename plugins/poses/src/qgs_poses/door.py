"""What qgs asks for where photos have no cameras, or a video is given: a folder with poses."""

from pathlib import Path

from rich.console import Console

from qgs_poses.making import Options, fingerprint, make_poses, read_record
from qgs_poses.photos import PosesError


def posed_folder(source: Path) -> Path:
    """The poses of the photos or the video `source`, beside it in NAME_poses; made if need be.

    Raises PosesError where they belong to other photos than are there now, and as `make_poses`.
    """
    out = beside(source)
    if record := read_record(out):
        if record.get("source") != fingerprint(source):
            raise PosesError(
                f"{out} has the poses of what {source} held before: delete it, so that they are "
                f"made anew, or run `qgs poses {source} --out FOLDER` and give that folder"
            )
        return out
    console = Console(stderr=True)
    text = f"{source} has no camera poses: they are made first, once, and kept in {out}"
    console.print(text, soft_wrap=True, highlight=False, markup=False)
    made = make_poses(source, out, Options(), console)
    for line in made.summary:
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    return out


def beside(source: Path) -> Path:
    """Where the poses of `source` are kept."""
    whole = source.resolve()
    return whole.with_name(f"{whole.stem if source.is_file() else whole.name}_poses")
