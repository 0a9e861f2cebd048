"""Describe the job of the process that runs COLMAP. This module imports no torch."""

from dataclasses import dataclass

LENS = {"camera_model": "SIMPLE_RADIAL"}
"""COLMAP's options for the cameras of all photos."""


@dataclass(frozen=True)
class Job:
    """Input of the process that runs COLMAP.

    images: folder of upright RGB photos. database: COLMAP's file for features and matches. models:
    folder for the results. groups: names of photos, in lists of photos that share a camera. sizes:
    (H, W) in pixels of the original photos, to which intrinsics are scaled. matching:
    "sequential" matches neighbours in the order of names, "alike" photos that look alike,
    "exhaustive" all pairs. features: largest number of features in a photo. threads: number of CPU
    threads. seed: random seed.
    """

    images: str
    database: str
    models: str
    groups: list[list[str]]
    sizes: dict[str, tuple[int, int]]
    matching: str
    features: int
    threads: int
    seed: int
