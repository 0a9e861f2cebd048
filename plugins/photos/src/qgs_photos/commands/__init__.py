"""Commands of this distribution; each imports what it needs when it runs, so help is fast."""

from pathlib import Path


def refuse_filled(out: Path) -> None:
    """Raise FileExistsError where `out` is a file or a folder that holds something."""
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise FileExistsError(f"{out} is not empty: choose another --out, or delete it yourself")


def refuse_no_time(option: str, value: float | None) -> None:
    """Raise ValueError for a time that is given and is not above 0, or infinite."""
    if value is not None and not 0 < value < float("inf"):
        raise ValueError(f"{option} must be a time above 0, got {value:g}")
