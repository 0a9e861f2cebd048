"""The range of views that a model was trained on, and how other views leave it.

Only cameras in the model's frame are compared, so it works for any data.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from qgs.geometry.poses import look_at_depth
from qgs.types import Cameras

OUTLIERS = 0.05
"""Share of the values at either end of a range that does not count, such as parallel axes."""
TOLERANCE = 1.25
"""Views are outside where they leave the trained range by more than this factor."""
KEY = "trained_on"
"""Key of `Domain.text` in the extra metadata of a checkpoint."""

WORDS = {
    "views": "there are {} input views",
    "baseline": "the largest distance between input cameras is {}",
    "turn": "their axes differ by {} degrees",
    "depth": "what they look at is {} away",
    "fov": "their field of view is {} degrees wide",
}
"""What is measured of a sample, lengths in the model's units."""
REMEDY = "try another scale of the world, other input views, or train on views like these"
"""What may bring views into the trained range."""


@dataclass
class Domain:
    """Measurements by name of WORDS, over `samples` samples; after loading only the two ends."""

    values: dict[str, list[float]] = field(default_factory=dict)
    samples: int = 0

    def see(self, inputs: Cameras, targets: Cameras) -> None:
        """Add samples: cameras (B, V_in) and (B, V_out) in the model's frame."""
        for name, values in _measured(inputs, targets):
            known = values[~values.isnan()].tolist()
            # Four digits are enough for a comparison that allows 25 %.
            self.values.setdefault(name, []).extend(float(f"{value:.4g}") for value in known)
        self.samples += len(inputs.c2w)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """(least, largest) of each name, without OUTLIERS of its values at either end."""
        found = {}
        for name, values in self.values.items():
            left_out = int(OUTLIERS * len(values))
            if kept := sorted(values)[left_out : len(values) - left_out]:
                found[name] = (kept[0], kept[-1])
        return found

    @property
    def text(self) -> str:
        """Its ranges as JSON; null stands for infinity."""
        # JSON has no infinity, which is the depth of parallel axes.
        ranges = {
            name: [end if math.isfinite(end) else None for end in ends]
            for name, ends in self.ranges.items()
        }
        return json.dumps({"samples": self.samples, "ranges": ranges})

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Domain:
        """Return the domain of a parsed `text`. Raises ValueError, TypeError or KeyError."""
        domain = cls(samples=int(plain["samples"]))
        for name, (low, high) in plain["ranges"].items():
            ends = [math.inf if end is None else float(end) for end in (low, high)]
            # NaN is not above 0 either.
            if name not in WORDS or not all(end >= 0 for end in (domain.samples, *ends)):
                raise ValueError(f"these are no ranges of views: {str(plain)[:100]}")
            domain.values[name] = ends
        return domain

    def differences(self, found: Domain) -> dict[str, str]:
        """Describe by name each range of the training that the range of `found` exceeds."""
        phrases: dict[str, str] = {}
        seen = found.ranges
        for name, trained in self.ranges.items():
            low, high = seen.get(name, trained)
            if low * TOLERANCE < trained[0] or high > trained[1] * TOLERANCE:
                words = WORDS[name].format(_shown((low, high)))
                phrases[name] = f"{words} (trained: {_shown(trained)})"
        return phrases


def verdict(trained: Domain, found: Domain) -> str:
    """Return a sentence that compares views with the training's, and what may help.

    trained: empty if unknown.
    """
    if not trained.values:
        return "the checkpoint does not record the views on which this model was trained"
    if outside := trained.differences(found):
        return (
            f"the views lie outside what this model was trained on: {', '.join(outside.values())}. "
            f"Expect a worse result than inside: {REMEDY}"
        )
    return (
        "the cameras lie within what this model was trained on, in distance, direction, depth and "
        "field of view; what they show may still be new to it"
    )


def _measured(inputs: Cameras, targets: Cameras) -> Iterator[tuple[str, Tensor]]:
    """Yield names of WORDS and their values; distances and axes only for several inputs."""
    count = inputs.c2w.shape[1]
    yield "views", torch.tensor([float(count)])
    if count > 1:
        # In float32 a cosine near 1 is off by angles of 0.02 degrees.
        c2w = inputs.c2w.double()
        yield "baseline", torch.cdist(c2w[..., :3, 3], c2w[..., :3, 3]).amax((-2, -1))
        axes = c2w[..., :3, 2]
        cosines = (axes @ axes.mT).amin((-2, -1)).clamp(-1, 1)
        yield "turn", cosines.arccos().rad2deg()
    depths = torch.stack([look_at_depth(c2w) for c2w in torch.cat([inputs.c2w, targets.c2w], 1)])
    # Axes that meet behind the cameras diverge in front of them: no depth, as of parallel ones.
    yield "depth", torch.where(depths > 0, depths, math.inf)
    halves = inputs.size[1] / 2 / inputs.intrinsics[..., 0].double()
    yield "fov", 2 * halves.arctan().rad2deg()


def _shown(values: tuple[float, float]) -> str:
    """Return a range as text, three digits."""
    low, high = (f"{value:.3g}" if math.isfinite(value) else "infinitely far" for value in values)
    return low if low == high else f"{low} to {high}"
