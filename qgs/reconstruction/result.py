"""The result of a reconstruction: Gaussians, renderings, and their scores against photos."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from qgs.containers import concatenated
from qgs.data.samples import Sample, in_photos_world, in_world
from qgs.domain import REMEDY
from qgs.files import AnyPath
from qgs.geometry.transforms import moved
from qgs.metrics.baselines import BASELINES, worse_than_nearest
from qgs.metrics.images import Psnr, psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import FoundScale, FoundSize
from qgs.types import Cameras, Gaussians, Rendering

KINDS = ("input", "novel", "seen in training")
"""Kinds of scored views: an input, a view new to the model, or a view of its training data."""


@dataclass(frozen=True)
class ViewScore:
    """Quality of a rendered view, compared with its photo.

    kind: "input", "novel" or "seen in training". psnr: in dB. baselines: PSNR in dB of each
        baseline method, by name; empty for an input.
    """

    frame: int
    kind: str
    psnr: float
    baselines: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Reconstruction:
    """Gaussians (1, G) that `model` made of a sample, in the model's world, and their quality.

    rendering: images of all views of the sample, inputs first. scores: one for each of these views.
    tuning, refinement: settings with which the Gaussians were fitted to photos; None if not fitted.
    remarks: sentences for the user. scale, size: results of the searches for the scale and for the
        image size; None without a search.
    """

    model: QueryGaussianModel
    sample: Sample
    gaussians: Gaussians
    rendering: Rendering
    scores: list[ViewScore]
    tuning: Mapping[str, Any] | None = None
    refinement: Mapping[str, Any] | None = None
    remarks: Sequence[str] = ()
    scale: FoundScale | None = None
    size: FoundSize | None = None

    @property
    def worse_than_nearest(self) -> str:
        """Remark if the nearest inputs match compared photos better than renderings do; else ""."""
        compared = [score for score in self.scores if score.baselines]
        if not compared:
            return ""
        model = fmean(score.psnr for score in compared)
        nearest = fmean(score.baselines["nearest_input"] for score in compared)
        remedy = f"{REMEDY}; or fit the result to its photos, to more photos or longer (qgs refine)"
        return worse_than_nearest(Psnr.column, model, nearest, remedy)

    @property
    def in_photos_world(self) -> Gaussians:
        """Gaussians (1, G) in the frame and unit of the photos' cameras."""
        reference, scale = self.sample.world
        return moved(self.gaussians, reference, 1 / float(scale))

    @property
    def input_cameras(self) -> dict[str, Cameras]:
        """Cameras (1, 1) of the input photos, in the photos' world, by their labels."""
        labels = map(self.sample.short_label, self.sample.input_frames)
        return in_photos_world(self.sample.world, self.sample.inputs.cameras, labels)

    def render(self, cameras: Cameras) -> Rendering:
        """Render from cameras (1, V) in the photos' world; depths are in the unit of that world."""
        reference, scale = self.sample.world
        own = in_world(self.sample.world, cameras.to(reference)).to(self.gaussians.means.device)
        with torch.no_grad():
            seen = self.model.render(self.gaussians, own)
        return replace(seen, depth=seen.depth / float(scale))

    def save(self, out: AnyPath) -> list[Path]:
        """Write the result to the folder or file `out` like `qgs reconstruct`; return the paths."""
        # Matplotlib is slow to import.
        from qgs.reconstruction.saving import write_reconstruction

        return write_reconstruction(self, Path(out))

    def __repr__(self) -> str:
        """Return the scene's name, the PSNR of each view, the scale that was found, and remarks."""
        lines = [f"Reconstruction of {self.sample.scene}: {self.gaussians.count:,} Gaussians"]
        for score in self.scores:
            lines.append(f"{score.kind} {self.sample.short_label(score.frame)} {score.psnr:.2f} dB")
        if self.scale:
            lines.append(self.scale.text)
        return "\n  ".join([*lines, *self.remarks])

    def _repr_png_(self) -> bytes:
        from qgs.drawing.images import png_bytes
        from qgs.reconstruction.saving import overview

        return png_bytes(overview(self))


@torch.no_grad()
def reconstruct_sample(
    model: QueryGaussianModel,
    sample: Sample,
    seen: Collection[int] = (),
    changed: Gaussians | None = None,
) -> Reconstruction:
    """Reconstruct `sample` on the model's device, render its views and score them.

    seen: frames that the model was trained on. changed: Gaussians to use in place of those from a
        forward pass; None runs the model.
    """
    device = model.device
    # Views come from the data on the CPU.
    sample = replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
    gaussians = model(sample.inputs).gaussians if changed is None else changed
    rendering = model.render(gaussians, sample_cameras(sample))
    return Reconstruction(
        model=model,
        sample=sample,
        gaussians=gaussians,
        rendering=rendering,
        scores=_scores(sample, rendering, seen),
    )


def _scores(sample: Sample, rendering: Rendering, seen: Collection[int]) -> list[ViewScore]:
    """Return the PSNR of each rendered view, and at target views also that of the baselines."""
    inputs = sample.inputs
    targets = sample.targets
    photos = torch.cat([inputs.images, targets.images], 1)
    quality = psnr(rendering.rgb, photos)[0].tolist()
    # What needs no model, on the same views.
    baselines = {
        name: psnr(baseline(inputs, targets.cameras), targets.images)[0].tolist()
        for name, baseline in BASELINES.items()
    }
    scores = [ViewScore(f, "input", q) for f, q in zip(sample.input_frames, quality, strict=False)]
    for index, frame in enumerate(sample.target_frames):
        kind = "seen in training" if frame in seen else "novel"
        others = {name: values[index] for name, values in baselines.items()}
        scores.append(ViewScore(frame, kind, quality[len(scores)], others))
    return scores


def sample_cameras(sample: Sample) -> Cameras:
    """Return the cameras (1, V) of a sample: those of the inputs, then those of the targets."""
    return concatenated([sample.inputs.cameras, sample.targets.cameras], 1)
