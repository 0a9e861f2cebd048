"""The range of cameras that a model was trained on, and comparison of new cameras with it.

Only cameras in the model's frame are compared, not images, so this works for any data.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from qgs.geometry.poses import look_at_depth
from qgs.types import Cameras

OUTLIERS = 0.05
"""Fraction of values that is ignored at each end of a range, because there may be outliers."""
TOLERANCE = 1.25
"""Factor by which a value may exceed the trained range and still count as inside."""
KEY = "trained_on"
"""Key under which a checkpoint's metadata stores `Domain.text`."""

WORDS = {
    "views": "there are {} input views",
    "baseline": "the largest distance between input cameras is {}",
    "turn": "their axes differ by {} degrees",
    "depth": "the point they look at is {} away",
    "fov": "their field of view is {} degrees wide",
    "side": "the shorter side of their images has {} pixels",
}
"""Phrases for messages, by name of a measurement of a sample's cameras; lengths in model units."""
REMEDY = "try another scale of the world, other input views or size, or train on views like these"
"""Advice for views outside of the trained range."""


@dataclass
class Domain:
    """Measurements of the cameras of several samples, such as their distances and angles.

    values: all measured values, by the names in WORDS. After loading from a checkpoint, there are
        only the smallest and largest value under each name.
    samples: number of measured samples.
    """

    values: dict[str, list[float]] = field(default_factory=dict)
    samples: int = 0

    def see(self, inputs: Cameras, targets: Cameras) -> None:
        """Measure the cameras of a sample, (1, V) in the model's frame, and add the values."""
        # In float32 a cosine near 1 is off by angles of 0.02 degrees.
        c2w = inputs.c2w[0].double()
        measured = {"views": [float(len(c2w))], "side": [float(min(inputs.size))]}
        # Distances and axes only for several inputs.
        if len(c2w) > 1:
            places = c2w[:, :3, 3]
            axes = c2w[:, :3, 2]
            turn = (axes @ axes.mT).min().clamp(-1, 1).arccos().rad2deg()
            measured["baseline"] = [float(torch.cdist(places, places).max())]
            measured["turn"] = [float(turn)]
        depth = float(look_at_depth(torch.cat([inputs.c2w[0], targets.c2w[0]])))
        halves = inputs.size[1] / 2 / inputs.intrinsics[0, :, 0].double()
        # Axes that meet behind the cameras diverge in front of them: no depth, as parallel ones.
        measured["depth"] = [depth if depth > 0 else math.inf]
        measured["fov"] = (2 * halves.arctan().rad2deg()).tolist()
        for name, values in measured.items():
            # Four digits are enough for a comparison that allows 25 %.
            known = [float(f"{value:.4g}") for value in values if not math.isnan(value)]
            self.values.setdefault(name, []).extend(known)
        self.samples += 1

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest value by name, after dropping the fraction OUTLIERS at each end."""
        found = {}
        for name, values in self.values.items():
            left_out = int(OUTLIERS * len(values))
            if kept := sorted(values)[left_out : len(values) - left_out]:
                found[name] = (kept[0], kept[-1])
        return found

    @property
    def text(self) -> str:
        """Ranges and number of samples as JSON, in which null stands for infinity."""
        # JSON has no infinity, which is the depth of parallel axes.
        ranges = {
            name: [end if math.isfinite(end) else None for end in ends]
            for name, ends in self.ranges.items()
        }
        return json.dumps({"samples": self.samples, "ranges": ranges})

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Domain:
        """Return the domain that `plain`, the parsed JSON of `text`, describes.

        Raises ValueError, TypeError or KeyError for damaged content.
        """
        domain = cls(samples=int(plain["samples"]))
        for name, (low, high) in plain["ranges"].items():
            ends = [math.inf if end is None else float(end) for end in (low, high)]
            # NaN is not above 0 either.
            if name not in WORDS or not all(end >= 0 for end in (domain.samples, *ends)):
                raise ValueError(
                    f"a range has an unknown name, or a number is < 0 or NaN: {str(plain)[:100]}"
                )
            domain.values[name] = ends
        return domain

    def differences(self, found: Domain) -> list[str]:
        """Describe each measurement whose range in `found` exceeds the one in `self`."""
        phrases: list[str] = []
        seen = found.ranges
        for name, trained in self.ranges.items():
            low, high = seen.get(name, trained)
            most = trained[1] * TOLERANCE
            # A third input between two gives better results than two.
            if name == "views" and trained[1] == 2:
                most = 3
            if low * TOLERANCE < trained[0] or high > most:
                words = WORDS[name].format(shown((low, high)))
                phrases.append(f"{words} (trained: {shown(trained)})")
        return phrases


def verdict(trained: Domain, found: Domain) -> str:
    """Return a sentence that says whether cameras lie in the trained range, with advice if not.

    trained: measurements of the training cameras; empty if unknown. found: measurements of the
        cameras to check.
    """
    if not trained.values:
        return "the checkpoint does not record the views on which this model was trained"
    if outside := trained.differences(found):
        return (
            f"the views lie outside the range of the training: {', '.join(outside)}. "
            f"Expect a worse result; {REMEDY}"
        )
    return (
        "the cameras lie within the range of the training, in distance, direction, depth, field of "
        "view and image size; the content of the photos may still be new to the model"
    )


def shown(values: tuple[float, float]) -> str:
    """Return a range as text, its numbers with three digits."""
    low, high = (f"{value:.3g}" if math.isfinite(value) else "infinitely far" for value in values)
    return low if low == high else f"{low} to {high}"
