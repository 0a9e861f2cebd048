"""A small model of each kind, and a scene of random photos that a camera walks past."""

import math
from collections.abc import Sequence
from copy import deepcopy
from functools import cache

import torch
from qgs_viewer.figures.exhibits import Exhibit, Exhibition, exhibit
from qgs_viewer.sources import ModelSource
from torch import Tensor

from qgs.composer import resolve
from qgs.contracts import Scene, ViewsConfig
from qgs.data.samples import Sample, make_sample
from qgs.geometry.poses import look_at
from qgs.model import QueryGaussianModel
from qgs.types import Cameras

QUERIES, FRAMES, SIDE = 12, 6, 64
VIEWS = ViewsConfig(inputs=2, gap=(1, 5), scale="auto")
KINDS = ("tokengs", "locus", "ellipsoid")


@cache
def model_of(kind: str) -> QueryGaussianModel:
    """Untrained, with QUERIES queries."""
    torch.manual_seed(0)
    recipe = resolve(f"recipes/tiny/{kind}.yaml", [f"model.queries.count={QUERIES}"])
    return recipe.build_model().eval()


class Walk(Scene):
    """Photos of noise by cameras on an arc that look at one point, principal point off centre."""

    name = "walk"

    def __init__(self) -> None:
        self._images = torch.rand(FRAMES, 3, SIDE, SIDE, generator=torch.manual_seed(1))

    @property
    def cameras(self) -> Cameras:
        angles = torch.linspace(-0.5, 0.5, FRAMES).double()
        eye = torch.stack([3 * angles.sin(), 0.2 * angles, 5 - 3 * angles.cos()], -1)
        target = torch.tensor([0.0, 0.0, 5.0]).double()
        c2w = look_at(eye, target - eye, torch.tensor([0.0, 1.0, 0.0]).double().expand_as(eye))
        focal = SIDE / (2 * math.tan(0.5))
        lens = torch.tensor([focal, 1.1 * focal, SIDE / 2 + 3, SIDE / 2 - 2]).double()
        return Cameras(c2w, lens.expand(FRAMES, 4), (SIDE, SIDE))

    def images(self, frames: Sequence[int]) -> Tensor:
        return self._images[list(frames)]

    def frame_name(self, frame: int) -> str:
        return f"photos/{frame:02d}.png"


def source_of(kind: str) -> ModelSource:
    return ModelSource(model_of(kind), Walk(), VIEWS, (1, 4), f"{kind}: walk")


def sample_of(inputs: Sequence[int] = (1, 4)) -> Sample:
    """The walk as a model sees it: frames 2 and 3 from others."""
    return make_sample(Walk(), tuple(inputs), (2, 3), VIEWS, mirror=False)


@cache
def exhibit_of(kind: str) -> Exhibit:
    """Of the small model with refinements that move anchors, as trained ones do."""
    model, random = deepcopy(model_of(kind)), torch.Generator().manual_seed(2)
    for parameter in model.refinements.parameters():
        parameter.data += 0.03 * torch.randn(parameter.shape, generator=random)
    return exhibit(kind, model, sample_of())


def exhibition_of(*kinds: str, query: int | None = None) -> Exhibition:
    samples = [sample_of(), sample_of((0, 5))]
    return Exhibition([exhibit_of(kind) for kind in kinds], samples, query)
