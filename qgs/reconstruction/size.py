"""Choice between the size of photos and its half: at which a model renders photos better."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.samples import Sample, halved, make_sample
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import further_photos
from qgs.types import Gaussians, Size
from qgs.wording import listed


@dataclass(frozen=True)
class FoundSize:
    """The better of two image sizes (H, W), and the other one.

    gaussians: (1, G), what the model makes of the inputs at this size. psnr, other_psnr: mean PSNR
        in dB at the two sizes. names: file names of the photos that decided.
    """

    size: Size
    other: Size
    gaussians: Gaussians
    psnr: float
    other_psnr: float
    names: Sequence[str]

    @property
    def text(self) -> str:
        """Sentence that gives the size, the photos that decided, and the PSNR of both sizes."""
        best = f"size {self.size[0]} x {self.size[1]}: {self.psnr:.1f} dB on {listed(self.names)}"
        return f"{best} ({self.other[0]} x {self.other[1]}: {self.other_psnr:.1f} dB)"


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
        found.append((float(psnr(reduced, photos).mean()), sample.inputs.cameras.size, gaussians))
    worse, best = sorted(found, key=lambda one: one[0])
    return FoundSize(
        best[1], worse[1], best[2], best[0], worse[0], [*map(scene.frame_name, judges)]
    )


def half(sample: Sample) -> Sample:
    """Return `sample` with images of half the height and width."""
    return replace(sample, inputs=halved(sample.inputs), targets=halved(sample.targets))
