"""Paths that are folders of this machine or fsspec URLs."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from upath import UPath

_PACKAGES = {
    "http": "requests aiohttp",
    "https": "requests aiohttp",
    "s3": "s3fs",
    "s3a": "s3fs",
    "gs": "gcsfs",
    "gcs": "gcsfs",
    "az": "adlfs",
    "abfs": "adlfs",
    "abfss": "adlfs",
    "hf": "huggingface_hub",
    "sftp": "paramiko",
    "ssh": "paramiko",
    "smb": "smbprotocol",
    "webdav": "webdav4",
}
"""What file systems of fsspec need, by protocol."""


def opened_path(path: str | Path | UPath) -> UPath:
    """`path` as a UPath: an fsspec URL such as s3://bucket/folder, or a local path with ~ expanded.

    A file: URL becomes the plain path it names. Raises ValueError for a URL of an unknown file
    system or of one whose package is missing.
    """
    try:
        url = UPath(path)
        url.fs  # noqa: B018  asks for the file system, whose package may be missing
    except ImportError as error:
        raise ValueError(f"{path} cannot be opened: {error}{_remedy(str(path))}") from error
    except ValueError as error:
        raise ValueError(f"{path} cannot be opened as a path or URL: {error}") from error
    if url.protocol in {"file", "local"}:
        return UPath(url.path)
    return url.expanduser() if is_local(url) else url


def _remedy(url: str) -> str:
    packages = _PACKAGES.get(url.partition(":")[0])
    return f": pip install {packages}" if packages else ""


def is_local(path: Path | UPath) -> bool:
    """Whether the system can open `path` by its name, as torch and zipfile do."""
    return isinstance(path, Path)


def stays_inside(name: str) -> bool:
    """Whether a relative name, of either kind of slash, leads nowhere above where it starts."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return bool(parts) and parts[0] != "/" and ".." not in parts and ":" not in parts[0]
