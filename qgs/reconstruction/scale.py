"""Search for the scale and the size of photos: those at which a model renders them best.

The scale is a factor of camera positions.

Camera positions of photos may be in any unit, but a model needs the unit of its training. So the
model runs on the inputs at several factors, and the factor with the best PSNR of rendered photos is
chosen. Inputs alone mislead: if the factor is too small, the model can reproduce the inputs by
surfaces close to the cameras. So a few photos that are not inputs are scored too.

Most factors need no trial: depth maps or a plane sweep show how far away the things are that the
inputs show, and in training their depth was about 1.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import NamedTuple

import torch
import torch.nn.functional as F

from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.inputs import BASELINE, seen_depth
from qgs.data.samples import Sample, make_sample, shrunk
from qgs.domain import Domain
from qgs.geometry.poses import scaled
from qgs.metrics.baselines import pose_distance
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scenes import LEAST
from qgs.types import Gaussians, Views
from qgs.wording import listed

FURTHER = 2
"""Largest number of photos that are scored in addition to the inputs."""
STEP = 1.6
"""Ratio of neighbouring factors in the coarse search."""
MOST = 16
"""Largest number of factors in the coarse search."""
BELOW = 2.0
"""Ratio of the smallest baseline in training to the smallest that the search tries."""
ABOVE = 4.0
"""Ratio of the largest baseline that the search tries to the largest in training."""
DEPTHS = (0.4, 2.0)
"""Smallest and largest median depth of what the inputs show at the factors that are tried, if this
depth is known. On real photos, the best factors gave 0.39 to 2.05."""
POOR = 14.0
"""PSNR in dB that the best factor must reach. If it does not, no scale fits, and novel views have
about 12 dB."""


@dataclass(frozen=True)
class FoundScale:
    """Result of the search: the best factor of camera positions, and its quality.

    further: scored frames that the search did not give to the model. names: their file names.
    psnr: mean PSNR in dB of inputs and further photos, where further photos have twice the weight.
    tried: pairs of a tried factor and its mean PSNR. depth: `seen_depth` of the inputs.
    """

    factor: float
    psnr: float
    further: Frames
    names: Sequence[str]
    tried: Sequence[tuple[float, float]]
    depth: float

    @property
    def poor(self) -> str:
        """Remark if no factor gave a good result, or if inputs alone tell the scale; else ""."""
        # NaN is poor too.
        if not self.psnr >= POOR:
            return (
                f"no scale fits: the best gives only {self.psnr:.1f} dB; choose inputs that "
                "overlap more (frames), or set the scale (--scale, views.scale_factor)"
            )
        if self.further or self.depth:
            return ""
        return (
            "the scale was found on input photos only and may be wrong: add photos between them, "
            "or set the scale (--scale, views.scale_factor)"
        )

    @property
    def text(self) -> str:
        """Sentence that gives the factor, the scored photos and their PSNR."""
        judged = f"the inputs and {listed(self.names)}" if self.names else "the inputs"
        return f"scale {self.factor:.3g}, found on {judged}: {self.psnr:.1f} dB"


def photo_settings(views: ViewsConfig, own: bool, overrides: Sequence[str] = ()) -> ViewsConfig:
    """Return `views` with the scale "search" in place of "constant", for photos in unknown units.

    A constant scale stays if the model was trained on these photos (`own`), or if the user's
    `overrides` of the recipe set the scale.
    """
    known = own or any(text.startswith("views.scale") for text in overrides)
    search = views.scale == "constant" and not known
    return views.model_copy(update={"scale": "search"}) if search else views


def constant_scale(views: ViewsConfig, factor: float) -> ViewsConfig:
    """Return `views` with the constant scale `factor`."""
    return views.model_copy(update={"scale": "constant", "scale_factor": factor})


@torch.no_grad()
def find_scale(
    model: QueryGaussianModel, scene: Scene, inputs: Frames, compared: Frames, views: ViewsConfig
) -> FoundScale:
    """Search for the factor at which `model` renders photos of `scene` best.

    The inputs and `further_photos` are scored, at `half` their size to save time. The coarse search
    tries factors with ratio STEP over `search_range`, and goes on past an end of the range while
    the best factor is there. The fine search tries thirds of a step around the best factor, then
    the vertex of a parabola through the three best scores in log scale.

    Of three or more inputs, the middle one is not given to the model, but scored in place of a
    further photo. This takes less time.
    model: must be in evaluation mode; the search runs on its device. compared: frames
        kept for the scores of the result, which the search does not render.
    """
    given = tuple(inputs)
    further = further_photos(scene, inputs, compared)
    if len(given) > 2:
        middle = given[len(given) // 2]
        further = (middle, *further[: FURTHER - 1])
        given = tuple(frame for frame in given if frame != middle)
    sample = make_sample(scene, given, further, constant_scale(views, 1.0))
    frames = given if len(given) > 1 else given + further
    sample = half(sample, model) or sample
    depth = seen_depth(scene, inputs)
    low, high = search_range(model.trained_on, scene, frames, depth)
    # Even steps in log scale: what counts is the ratio to the right factor.
    count = min(math.ceil(math.log(high / low) / math.log(STEP)) + 1, MOST)
    ratio = (high / low) ** (1 / max(count - 1, 1))
    # Places are thirds of a step, so that the finer search lies between those of the first.
    trial = _Trial(
        model,
        sample.inputs.joined(sample.targets).to(model.device),
        len(given),
        # Photos that are not given count twice: inputs alone mislead.
        [1 / len(given) for _ in given] + [2 / len(further) for _ in further],
        low,
        ratio ** (1 / 3),
    )
    best = trial.best(range(0, 3 * count, 3))
    if ratio > 1:
        # Inputs alone would lead further and further away from a depth that is known.
        while (further or not depth) and (end := trial.past(best)) and len(trial.tried) < MOST:
            best = trial.best(end)
        # The second time, only the place beyond a better one is new.
        for _ in range(2):
            best = trial.best([best - 1, best + 1])
        best = trial.best([best + trial.vertex(best)])
    return FoundScale(
        factor=trial.factor(best),
        psnr=trial.tried[best],
        further=further,
        names=[*map(scene.frame_name, further)],
        tried=sorted((trial.factor(place), found) for place, found in trial.tried.items()),
        depth=depth,
    )


def further_photos(scene: Scene, inputs: Frames, compared: Frames) -> Frames:
    """Return at most FURTHER photos near the inputs, by which `find_scale` scores factors.

    These are the photos whose largest `pose_distance` to an input is smallest. Inputs, compared
    photos and held-out photos are left out. For a scene with times, the result is empty.
    """
    left = [f for f in range(len(scene)) if f not in {*inputs, *compared, *scene.held_out}]
    if scene.times is not None or not left:
        return ()
    c2w = scene.cameras.c2w.double()
    far = pose_distance(c2w[None, list(inputs)], c2w[None, left])[0].amax(1).tolist()
    return tuple(sorted(frame for _, frame in sorted(zip(far, left, strict=True))[:FURTHER]))


def search_range(
    trained: Domain, scene: Scene, frames: Frames, depth: float
) -> tuple[float, float]:
    """Return the least factor and the largest factor to try.

    At these factors, the baseline of the inputs and the depth of what they show are about those of
    training.
    trained: baselines in the model's training. frames: the inputs. depth: median depth of what they
        show; 0 if it is unknown.
    """
    centres = scene.cameras.c2w[list(frames), :3, 3].double()
    baseline = float(torch.cdist(centres, centres).max())
    # A baseline is the largest distance between the inputs of a sample.
    least, most = trained.ranges.get("baseline", BASELINE)
    # Cameras on one point leave nothing to search: no factor changes what they see.
    if not baseline or not most:
        return 1.0, 1.0
    # A training may have seen baselines near 0, which no search needs to reach.
    low = max(least, most / 10) / baseline / BELOW
    high = most / baseline * ABOVE
    near, far = trained.ranges.get("depth", DEPTHS)
    # A training in another unit has other depths than DEPTHS.
    if not depth or near >= DEPTHS[1] or far <= DEPTHS[0]:
        return low, high
    if low * depth < DEPTHS[1] and high * depth > DEPTHS[0]:
        low = max(low, DEPTHS[0] / depth)
        high = min(high, DEPTHS[1] / depth)
    return low, high


@dataclass
class _Trial:
    """Mean PSNR of renderings for several factors of the camera positions.

    A place p is an exponent: it stands for the factor low * step ** p.
    views: (1, V), whose cameras have the factor 1; the first `inputs` of them are given to the
        model. weights: weights of the views in the mean PSNR. tried: mean PSNR in dB by place.
    """

    model: QueryGaussianModel
    views: Views
    inputs: int
    weights: Sequence[float]
    low: float
    step: float
    tried: dict[float, float] = field(default_factory=dict)

    def factor(self, place: float) -> float:
        return self.low * self.step**place

    def score(self, place: float) -> float:
        found = self.tried[place]
        return -math.inf if math.isnan(found) else found

    def best(self, places: Iterable[float]) -> float:
        """Score the factors at `places`; return the best of all places scored so far."""
        for place in places:
            if place in self.tried:
                continue
            views = at_factor(self.views, self.factor(place))
            gaussians = self.model(views.select(slice(self.inputs))).gaussians
            seen = self.model.render(gaussians, views.cameras).rgb
            self.tried[place] = fmean(psnr(seen, views.images)[0].tolist(), self.weights)
        return max(self.tried, key=self.score)

    def past(self, place: float) -> Sequence[float]:
        """Return two places to try beyond `place` if it is the least or largest tried; else [].

        A place p stands for the factor low * step ** p.
        """
        if place == min(self.tried):
            return [place - 6, place - 3]
        return [place + 3, place + 6] if place == max(self.tried) else []

    def vertex(self, place: float) -> float:
        """Return the offset from `place` to the maximum of a parabola through three scores.

        The scores are at `place` - 1, `place` and `place` + 1. Returns 0 if one of them is missing
        or if the parabola has no maximum.
        """
        if not {place - 1, place + 1} <= self.tried.keys():
            return 0.0
        left, middle, right = (self.score(place + side) for side in (-1, 0, 1))
        bend = left - 2 * middle + right
        return 0.5 * (left - right) / bend if bend < 0 else 0.0


def at_factor(views: Views, factor: float) -> Views:
    """Return views whose camera positions are multiplied by `factor`."""
    c2w = scaled(views.cameras.c2w, factor)
    return views.replace(cameras=views.cameras.replace(c2w=c2w))


class FoundSize(NamedTuple):
    """The better of two image sizes.

    halved: whether it is half of the scene's. gaussians: (1, G), what the model makes of the inputs
    at this size. text: sentence that gives both sizes, their PSNR, and the photos that decided.
    """

    halved: bool
    gaussians: Gaussians
    text: str


@torch.no_grad()
def find_size(
    model: QueryGaussianModel, scene: Scene, inputs: Frames, compared: Frames, views: ViewsConfig
) -> FoundSize | None:
    """Decide at which image size `model` is better: that of `scene`, or half its height and width.

    The judges are `further_photos`, or the inputs if there are none. Renderings are compared at the
    smaller size. Of equally good sizes, the larger one is taken. Returns None if `half` does, and
    for scenes with times.
    model: in evaluation mode. inputs, compared: frames, see `find_scale`. views: with the scale
        that was found.
    """
    judges = further_photos(scene, inputs, compared) or inputs
    whole = make_sample(scene, inputs, judges, views)
    small = half(whole, model)
    # Inputs of other times than the compared photos are no judges.
    if small is None or scene.times is not None:
        return None
    photos = small.targets.images[0]
    device = model.device
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


def half(sample: Sample, model: QueryGaussianModel) -> Sample | None:
    """Return `sample` with images of half the height and width.

    Returns None if their shorter side has at most LEAST pixels, or if `model` takes no such images.
    """
    multiple = model.encoder.size_multiple(model.encoder.config)
    size = sample.inputs.cameras.size
    if multiple is None or min(size) <= LEAST or any(side % (2 * multiple) for side in size):
        return None
    return replace(sample, inputs=shrunk(sample.inputs, 2), targets=shrunk(sample.targets, 2))
