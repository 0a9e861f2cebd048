"""The reconstruction of one scene: which photos are inputs, Gaussians, scores against photos."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from qgs.contracts import Scene, ViewsConfig
from qgs.data.inputs import NOVEL, Frusta, Window, choose_windows
from qgs.data.samples import Sample, evenly, make_sample, moments, own_world, spread
from qgs.domain import Domain, remedies
from qgs.evaluate.plan import ViewsOf
from qgs.geometry.poses import relative_to, scaled
from qgs.geometry.transforms import moved
from qgs.metrics.baselines import BASELINES, worse_than_nearest
from qgs.metrics.images import Psnr, psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import FoundScale
from qgs.types import Cameras, Gaussians, Prediction, Rendering
from qgs.wording import listed

KINDS = ("input", "novel", "seen in training")
"""A compared view of a folder that the model was trained on is novel if it was held out."""


def checked_window(total: int, frames: Sequence[int], compare: Sequence[int] = ()) -> Window:
    """Input frames and compared ones. Raises ValueError for one twice or not of 0 to total - 1."""
    every = [*frames, *compare]
    if missing := [frame for frame in every if not 0 <= frame < total]:
        raise ValueError(f"frames {listed(missing)} do not exist; the photos are 0..{total - 1}")
    if twice := sorted({frame for frame in every if every.count(frame) > 1}):
        raise ValueError(
            f"frames named twice: {listed(twice)}; inputs and compared frames must differ"
        )
    return tuple(frames), tuple(compare)


def choose_sample(
    scene: Scene,
    views: ViewsConfig,
    inputs: int | None,
    frames: Sequence[int] | None,
    compare: Sequence[int] | None,
    trained_on: Domain | None = None,
    views_of: ViewsOf | None = None,
) -> tuple[Sample, tuple[Tensor, Tensor]]:
    """Inputs and compared views of `scene`, and their world as of `own_world`.

    frames, compare: by default the best of `choose_windows`; where times are known, inputs spread
    over them, and views of one time between. trained_on: of the model. views_of: makes the settings
    of the chosen views, such as their scale; None takes `views`. Raises ValueError for frames that
    do not exist or come twice, and for too few.
    """
    views = views.model_copy(update={"inputs": inputs or views.inputs})
    domain, novel = trained_on or Domain(), tuple(compare or ())
    if frames is not None:
        checked_window(len(scene), frames)
    if scene.times is not None:
        frames, novel = _over_time(scene, scene.times, views, frames)
    elif frames is None:
        frames, novel = choose_windows(scene, views, domain, held_out=compare)[0]
    elif compare is None:
        novel = Frusta(scene, domain).compared(tuple(frames))
    picked = checked_window(len(scene), frames, novel if compare is None else compare)
    views = views_of(scene, *picked) if views_of else views
    sample = make_sample(scene, *picked, views, mirror=False)
    return sample, own_world(scene, picked[0], views)


def _over_time(
    scene: Scene, times: Tensor, views: ViewsConfig, frames: Sequence[int] | None
) -> Window:
    """Inputs, and at most NOVEL frames of one time between them, held-out ones where there are."""
    usable = moments(scene)
    if frames is None:
        if views.inputs > len(usable):
            raise ValueError(f"there are {len(usable)} times, too few for {views.inputs} inputs")
        first = max(len(usable) - max(views.gap[1] + 1, views.inputs), 0) // 2
        frames = spread(usable[first : len(usable) - first], views.inputs)
    between = [f for f in range(min(frames), max(frames) + 1) if f not in frames]
    novel = evenly([f for f in between if f in scene.held_out] or between, NOVEL)
    moment = times[novel[len(novel) // 2]] if novel else None
    return tuple(frames), tuple(frame for frame in novel if times[frame] == moment)


@dataclass(frozen=True)
class ViewScore:
    """A rendered view against its photo, of one of KINDS; PSNR in dB. baselines: not of inputs."""

    frame: int
    kind: str
    psnr: float
    baselines: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Reconstruction:
    """Gaussians (1, G) of a sample by `model`, in its world, rendered from all views of the sample.

    prediction: None where the Gaussians were tuned or refined; `tuning`, `refinement` are the
    records. world: reference pose (4, 4) and scale, as of `own_world`. remarks: for the user.
    scale: how the scale was found, None where it was set.
    """

    model: QueryGaussianModel
    sample: Sample
    prediction: Prediction | None
    gaussians: Gaussians
    rendering: Rendering
    scores: list[ViewScore]
    world: tuple[Tensor, Tensor]
    tuning: Mapping[str, Any] | None = None
    refinement: Mapping[str, Any] | None = None
    remarks: Sequence[str] = ()
    scale: FoundScale | None = None

    @property
    def worse_than_nearest(self) -> str:
        """See `qgs.metrics.baselines`; on the compared views."""
        rows = [(s.psnr, s.baselines["nearest_input"]) for s in self.scores if s.baselines]
        if not rows:
            return ""
        model, nearest = (sum(values) / len(rows) for values in zip(*rows, strict=True))
        tries = remedies(("baseline", "depth"), ["scale"] if self.scale else [])
        remedy = f"{tries}; `qgs refine` fits the result to its photos"
        remedy = "refine for longer, or on more photos" if self.refinement else remedy
        return worse_than_nearest(Psnr.column, model, nearest, remedy)

    @property
    def in_photos_world(self) -> Gaussians:
        """The Gaussians (1, G) in the frame and unit of the photos' cameras, as for `save_ply`."""
        reference, scale = self.world
        return moved(self.gaussians, reference, 1 / float(scale))

    def render(self, cameras: Cameras) -> Rendering:
        """Render from cameras (1, V) in the photos' world; depth is in its unit."""
        reference, scale = (part.to(cameras.c2w.device) for part in self.world)
        c2w = scaled(relative_to(reference, cameras.c2w.double()), scale).float()
        own = Cameras(c2w, cameras.intrinsics.float(), cameras.size).to(self.gaussians.means.device)
        with torch.no_grad():
            seen = self.model.render(self.gaussians, own)
        return replace(seen, depth=seen.depth / float(scale))

    def save(self, out: str | PathLike[str]) -> list[Path]:
        """Write the files of `qgs reconstruct` and return their paths."""
        from qgs.reconstruction.saving import write_reconstruction  # Matplotlib is slow to import

        return write_reconstruction(self, Path(out))

    def __repr__(self) -> str:
        """Scene, views with PSNR, the scale that was found, and the remarks."""
        views = [f"{s.kind} {self.sample.label(s.frame)} {s.psnr:.2f} dB" for s in self.scores]
        heading = f"Reconstruction of {self.sample.scene}: {self.gaussians.count:,} Gaussians"
        scale = [self.scale.text] if self.scale else []
        return "\n  ".join([heading, *views, *scale, *self.remarks])

    def _repr_png_(self) -> bytes:
        from qgs.drawing.images import png_bytes
        from qgs.reconstruction.saving import overview

        return png_bytes(overview(self, dpi=72))


@torch.no_grad()
def reconstruct_sample(
    model: QueryGaussianModel,
    sample: Sample,
    world: tuple[Tensor, Tensor],
    seen: Collection[int] = (),
    tuned: Gaussians | None = None,
    tuning: Mapping[str, Any] | None = None,
    refinement: Mapping[str, Any] | None = None,
) -> Reconstruction:
    """Gaussians of `sample`, rendered from its views, on the model's device.

    seen: frames that the model was trained on. tuned: use these Gaussians instead of a forward
    pass; `tuning` or `refinement` is the record of how they were made.
    """
    device = next(model.parameters()).device
    sample = replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
    prediction: Prediction | None = model(sample.inputs) if tuned is None else None
    gaussians = prediction.gaussians if prediction else tuned
    assert gaussians is not None
    inputs, targets = sample.inputs, sample.targets
    rendering = model.render(gaussians, sample_cameras(sample))
    quality = psnr(rendering.rgb[0], torch.cat([inputs.images[0], targets.images[0]])).tolist()
    baselines = {
        name: psnr(baseline(inputs, targets.cameras), targets.images)[0].tolist()
        for name, baseline in BASELINES.items()
    }
    count = len(sample.input_frames)
    scores = [ViewScore(f, "input", q) for f, q in zip(sample.input_frames, quality, strict=False)]
    for index, frame in enumerate(sample.target_frames):
        kind = "seen in training" if frame in seen else "novel"
        others = {name: values[index] for name, values in baselines.items()}
        scores.append(ViewScore(frame, kind, quality[count + index], others))
    made = model, sample, prediction, gaussians, rendering, scores, world
    return Reconstruction(*made, tuning, refinement)


def sample_cameras(sample: Sample) -> Cameras:
    """The cameras (1, V) of inputs, then targets."""
    a, b = sample.inputs.cameras, sample.targets.cameras
    intrinsics = torch.cat([a.intrinsics, b.intrinsics], 1)
    return Cameras(torch.cat([a.c2w, b.c2w], 1), intrinsics, a.size)
