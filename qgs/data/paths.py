"""Paths that are folders of this machine or fsspec URLs."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from upath import UPath


def opened_path(path: str | Path | UPath) -> UPath:
    """`path` as a UPath: an fsspec URL such as s3://bucket/folder, or a local path with ~ expanded.

    A file: URL becomes the plain path it names. Raises ValueError for a URL of an unknown file
    system or of one whose package is missing.
    """
    try:
        url = UPath(path)
        url.fs  # noqa: B018  asks for the file system, whose package may be missing
    except (ImportError, ValueError) as error:
        raise ValueError(f"{path} cannot be opened as a path or URL: {error}") from error
    if url.protocol in {"file", "local"}:
        return UPath(url.path)
    return url.expanduser() if is_local(url) else url


def is_local(path: Path | UPath) -> bool:
    """Whether the system can open `path` by its name, as torch and zipfile do."""
    return isinstance(path, Path)


def stays_inside(name: str) -> bool:
    """Whether a relative name, of either kind of slash, leads nowhere above where it starts."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return bool(parts) and parts[0] != "/" and ".." not in parts and ":" not in parts[0]
