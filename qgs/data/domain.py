"""On what views a model was trained, in a few numbers, and whether other views are like them.

All is told by cameras in the model's frame, which any source of data has, photos of a user too.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice

import torch
from torch import Tensor

from qgs.contracts import SceneSource, ViewsConfig
from qgs.data.stream import training_batches
from qgs.geometry.poses import look_at_depth
from qgs.types import Cameras

SAMPLES = 256
"""Training samples that are measured, the first ones."""
TOLERANCE = 1.1
"""Views are outside where they leave the trained range by more than this factor."""
KEY = "trained_on"
"""Where a checkpoint's extra metadata holds `Domain.text`."""

WORDS = {
    "views": "there are {} input views",
    "baseline": "the input cameras stand {} apart",
    "turn": "their axes differ by {} degrees",
    "depth": "what they look at is {} away",
    "fov": "their field of view is {} degrees wide",
}
"""What is measured of a sample, lengths in the model's units."""


@dataclass
class Domain:
    """Least and largest value of each of WORDS over `samples` samples, in four digits."""

    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    samples: int = 0

    def see(self, inputs: Cameras, targets: Cameras) -> None:
        """Count samples in: cameras (B, V_in) and (B, V_out) in the model's frame."""
        for name, values in _measured(inputs, targets):
            known = self.ranges.get(name, ())
            ends = [float(f"{float(value):.4g}") for value in (values.min(), values.max())]
            self.ranges[name] = min(*known, *ends), max(*known, *ends)
        self.samples += len(inputs.c2w)

    @property
    def text(self) -> str:
        """As JSON; null stands for infinity."""
        plain = {k: [v if math.isfinite(v) else None for v in r] for k, r in self.ranges.items()}
        return json.dumps({"samples": self.samples, "ranges": plain})

    @classmethod
    def read(cls, text: str) -> Domain:
        """What `text` wrote. Raises ValueError, TypeError, KeyError or AttributeError for else."""
        plain = json.loads(text)
        ends = {
            name: [math.inf if end is None else float(end) for end in plain["ranges"][name]]
            for name in WORDS
            if name in plain["ranges"]
        }
        return cls({name: (low, high) for name, (low, high) in ends.items()}, int(plain["samples"]))

    def differences(self, found: Domain) -> list[str]:
        """In what `found` leaves these ranges, in words."""
        told = []
        for name, trained in self.ranges.items():
            if name in found.ranges and not _inside(found.ranges[name], trained):
                words = WORDS[name].format(_shown(found.ranges[name]))
                if found.ranges[name][0] == math.inf:
                    words = "their axes meet at no point before them"
                told.append(f"{words} (trained: {_shown(trained)})")
        return told


def verdict(trained: Domain, found: Domain) -> str:
    """A sentence: how photos lie to what a model was trained on; empty where that is not known.

    The model need not know their content either: only the cameras are compared.
    """
    if not trained.ranges:
        return (
            "whether the photos are like those that this model was trained on is not known: its "
            "checkpoint does not tell, since an older qgs or other code trained it"
        )
    if apart := trained.differences(found):
        return (
            f"the photos lie outside what this model was trained on: {', '.join(apart)}. Expect a "
            "poor result; choose other input photos, or train on photos like these"
        )
    return (
        "the cameras lie within what this model was trained on, in distance, direction, depth and "
        "field of view; what they show may still be new to it"
    )


def trained_domain(source: SceneSource, views: ViewsConfig, seed: int) -> Domain:
    """The domain of the first SAMPLES training samples, as training itself finds it."""
    domain, size = Domain(), 16
    with closing(training_batches(source, views, size, seed)) as batches:
        for batch in islice(batches, SAMPLES // size):
            domain.see(batch.inputs.cameras, batch.targets.cameras)
    return domain


def _measured(inputs: Cameras, targets: Cameras) -> Iterator[tuple[str, Tensor]]:
    """Name and values of what WORDS names; distances and axes only where inputs are several."""
    count = inputs.c2w.shape[1]
    yield "views", torch.tensor([float(count)])
    if count > 1:
        c2w = inputs.c2w.double()
        yield "baseline", torch.cdist(c2w[..., :3, 3], c2w[..., :3, 3]).amax((-2, -1))
        axes = c2w[..., :3, 2]
        cosines = (axes @ axes.transpose(-2, -1)).amin((-2, -1)).clamp(-1, 1)
        yield "turn", cosines.arccos().rad2deg()
    depths = torch.stack([look_at_depth(c2w) for c2w in torch.cat([inputs.c2w, targets.c2w], 1)])
    yield "depth", torch.where(depths > 0, depths, math.inf)
    halves = inputs.size[1] / 2 / inputs.intrinsics[..., 0].double()
    yield "fov", 2 * halves.arctan().rad2deg()


def _inside(found: tuple[float, float], trained: tuple[float, float]) -> bool:
    return found[0] * TOLERANCE >= trained[0] and found[1] <= trained[1] * TOLERANCE


def _shown(values: tuple[float, float]) -> str:
    """A range in words, three digits."""
    low, high = (f"{value:.3g}" if math.isfinite(value) else "infinitely far" for value in values)
    return low if low == high else f"{low} to {high}"
