"""Choice of the image size at which a model reconstructs photos best."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.samples import make_sample
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import further_photos
from qgs.types import Gaussians, Size
from qgs.wording import listed


@dataclass(frozen=True)
class FoundSize:
    """The best of several image sizes.

    scene: the scene at this size. gaussians: (1, G), what the model makes of it. names: file names
        of the photos that decided. tried: tried sizes (H, W) and their mean PSNR in dB, the best
        first.
    """

    scene: Scene
    gaussians: Gaussians
    names: Sequence[str]
    tried: Sequence[tuple[Size, float]]

    @property
    def text(self) -> str:
        """Sentence that gives the size, the photos that decided, and the PSNR of all sizes."""
        (best, quality), *others = self.tried
        rest = [f"{_shown(size)}: {found:.1f} dB" for size, found in others]
        return f"size {_shown(best)}: {quality:.1f} dB on {listed(self.names)} ({listed(rest)})"


def _shown(size: Size) -> str:
    return f"{size[0]} x {size[1]}"


@torch.no_grad()
def find_size(
    model: QueryGaussianModel,
    scenes: Sequence[Scene],
    inputs: Frames,
    compared: Frames,
    views: ViewsConfig,
) -> FoundSize:
    """Run `model` on one scene at several sizes; return the size that renders photos best.

    The judges are `further_photos`, or the inputs if there are none. Renderings and photos are
    reduced to the size of the first scene. Of equally good sizes, the later one counts.
    model: in evaluation mode. scenes: from `at_sizes`. inputs, compared: frames, see `find_scale`.
        views: with the scale that was found.
    """
    judges = further_photos(scenes[0], inputs, compared) or inputs
    least = scenes[0].cameras.size
    device = next(model.parameters()).device
    found: list[FoundSize] = []
    names = [scenes[0].frame_name(frame) for frame in judges]
    for scene in scenes:
        sample = make_sample(scene, inputs, judges, views, mirror=False)
        photos = sample.targets.to(device)
        gaussians = model(sample.inputs.to(device)).gaussians
        seen = model.render(gaussians, photos.cameras).rgb
        pair = [F.interpolate(images[0], least, mode="area") for images in (seen, photos.images)]
        tried = (scene.cameras.size, float(psnr(*pair).mean()))
        found.append(FoundSize(scene, gaussians, names, [tried]))
    found.sort(key=lambda one: one.tried[0][1])
    tried = [one.tried[0] for one in reversed(found)]
    return replace(found[-1], tried=tried)
