"""What figures are made of: trained models side by side, on the scenes that judge them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from qgs.containers import map_tensors
from qgs.data.samples import Sample
from qgs.drawing.images import Picture, enlarged, rgb_picture
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians, SpatialSupport
from qgs_viewer.curves import Curves
from qgs_viewer.look import Look, look_inside
from qgs_viewer.queries import DrawnQuery, colored_queries, notable_queries, support_picture


class NothingToShowError(ValueError):
    """A figure that these models have nothing for; the message says why."""


@dataclass(frozen=True)
class Exhibit:
    """A model by name, its look at the inputs of `sample` in its own world, and its training."""

    name: str
    look: Look
    sample: Sample
    curves: Curves | None = None

    def anchors(
        self, layers: Iterable[int], chosen: Sequence[DrawnQuery], side: int
    ) -> list[Picture]:
        """The anchors after each of `layers` on the first input view, `chosen` with supports."""
        photo = enlarged(rgb_picture(self.sample.inputs.images[0, 0]), side)
        camera = self.sample.inputs.cameras[:, :1].to("cpu")
        colors = {query.index: query.color for query in chosen}
        return [support_picture(photo, support_of(self, at), camera, colors) for at in layers]

    @property
    def model(self) -> QueryGaussianModel:
        """The model."""
        assert self.look.inside is not None
        return self.look.inside.model

    @property
    def gaussians(self) -> Gaussians:
        """What it makes of the inputs."""
        return self.look.gaussians

    def notable(self, count: int, cameras: Cameras, query: int | None = None) -> list[DrawnQuery]:
        """`query`, or the `count` most notable ones in the first of cameras (1, V); ValueError."""
        if query is None:
            return notable_queries(self.model, self.gaussians, cameras, count)
        if not 0 <= query < self.look.queries:
            last = self.look.queries - 1
            raise ValueError(f"{self.name} has no query {query}; its queries are 0 to {last}")
        return colored_queries(self.gaussians, self.look.queries, [query])


@dataclass(frozen=True)
class Exhibition:
    """Models on the same scenes; the exhibits look at the first of `samples`.

    samples: with the true depth of targets where known. query: shown in figures of single queries;
    None for each model's most notable ones. notes: remarks on models and scenes.
    """

    exhibits: Sequence[Exhibit]
    samples: Sequence[Sample]
    query: int | None = None
    notes: Sequence[str] = ()

    @property
    def models(self) -> Mapping[str, QueryGaussianModel]:
        """By name."""
        return {exhibit.name: exhibit.model for exhibit in self.exhibits}

    @property
    def anchored(self) -> Sequence[Exhibit]:
        """The exhibits whose queries have a place. Raises NothingToShowError if there is none."""
        found = [e for e in self.exhibits if e.look.support(0) is not None]
        if not found:
            names = ", ".join(self.models)
            raise NothingToShowError(f"{names}: the queries have no anchors, so none are shown")
        return found

    @property
    def without_anchors(self) -> str:
        """The models that `anchored` leaves out, as a sentence; "" for none."""
        left = [e.name for e in self.exhibits if e.look.support(0) is None]
        return f" Not shown: {', '.join(left)}, whose queries have no anchors." if left else ""


def sample_name(sample: Sample, among: Sequence[Sample]) -> str:
    """The scene; with the span of its input frames where others are of the same scene."""
    if [other.scene for other in among].count(sample.scene) == 1:
        return sample.scene
    return f"{sample.scene} {min(sample.input_frames)}–{max(sample.input_frames)}"


def exhibit(
    name: str, model: QueryGaussianModel, sample: Sample, curves: Curves | None = None
) -> Exhibit:
    """`model`, and what it makes of the inputs of `sample`, on the model's device."""
    device, frames = next(model.parameters()).device, sample.input_frames
    inputs, targets = sample.inputs.to(device), sample.targets.to(device)
    here = replace(sample, inputs=inputs, targets=targets)
    labels = [sample.label(frame) for frame in frames]
    with torch.no_grad():
        return Exhibit(name, look_inside(model.eval(), inputs, labels, frames), here, curves)


def support_of(shown: Exhibit, layer: int) -> SpatialSupport:
    """Supports (1, N) after a layer, of a model with anchors; float32 on the CPU."""
    found = shown.look.support(layer)
    assert found is not None
    return map_tensors(lambda tensor: tensor.float(), found)
