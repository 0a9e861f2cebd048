"""Choice between the size of photos and its half: at which a model renders photos better."""

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F

from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.samples import Sample, halved, make_sample
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import further_photos
from qgs.types import Gaussians
from qgs.wording import listed


class FoundSize(NamedTuple):
    """Which of two image sizes is better.

    halved: whether it is half of the scene's. gaussians: (1, G), what the model makes of the inputs
    at this size. text: sentence that gives both sizes, their PSNR, and the photos that decided.
    """

    halved: bool
    gaussians: Gaussians
    text: str


@torch.no_grad()
def find_size(
    model: QueryGaussianModel, scene: Scene, inputs: Frames, compared: Frames, views: ViewsConfig
) -> FoundSize:
    """Return the better image size for `model`: that of `scene`, or half its height and width.

    The judges are `further_photos`, or the inputs if there are none. Renderings are compared at the
    smaller size. Of equally good sizes, the larger one is taken.
    model: in evaluation mode. inputs, compared: frames, see `find_scale`. views: with the scale
        that was found.
    """
    judges = further_photos(scene, inputs, compared) or inputs
    whole = make_sample(scene, inputs, judges, views, mirror=False)
    small = half(whole)
    photos = small.targets.images[0]
    device = next(model.parameters()).device
    found = []
    for sample in (small, whole):
        gaussians = model(sample.inputs.to(device)).gaussians
        seen = model.render(gaussians, sample.targets.cameras.to(device)).rgb[0]
        reduced = F.interpolate(seen.cpu(), photos.shape[-2:], mode="area")
        height, width = sample.inputs.cameras.size
        found.append((float(psnr(reduced, photos).mean()), f"{height} x {width}", gaussians))
    (worse, other, _), (best, size, gaussians) = sorted(found, key=lambda one: one[0])
    names = listed(map(scene.frame_name, judges))
    text = f"size {size}: {best:.1f} dB on {names} ({other}: {worse:.1f} dB)"
    return FoundSize(gaussians is found[0][2], gaussians, text)


def half(sample: Sample) -> Sample:
    """Return `sample` with images of half the height and width."""
    return replace(sample, inputs=halved(sample.inputs), targets=halved(sample.targets))
