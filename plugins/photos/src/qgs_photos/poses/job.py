"""Describe the job of the process that runs COLMAP. This module imports no torch."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Job:
    """Input of the process that runs COLMAP.

    images: folder of upright RGB photos. database: COLMAP's file for features and matches. models:
    folder for the results. groups: names of photos, in lists of photos that share a camera. sizes:
    (H, W) in pixels of the original photos, to which intrinsics are scaled. sequential: match only
    neighbours in the order of names. likely: if not `sequential`, match only photos that look
    alike. If both are False, all pairs are matched. features: largest number of features in a
    photo. threads: number of CPU threads. seed: random seed.
    """

    images: str
    database: str
    models: str
    groups: list[list[str]]
    sizes: dict[str, tuple[int, int]]
    sequential: bool
    likely: bool
    features: int
    threads: int
    seed: int
