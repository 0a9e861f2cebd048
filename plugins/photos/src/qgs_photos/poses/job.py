"""The job of the process that runs COLMAP; no torch is imported here."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Job:
    """Function that the process runs.

    images: folder of photos, upright RGB. database, models: of COLMAP. groups: names of photos that
    share a camera. sizes: (H, W) of each photo for which the result is. sequential: match
    neighbours by name alone.
    """

    images: str
    database: str
    models: str
    groups: list[list[str]]
    sizes: dict[str, tuple[int, int]]
    sequential: bool
    features: int
    threads: int
    seed: int
