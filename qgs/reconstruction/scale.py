"""The scale of a scene's world: the factor at which a model renders the photos best.

Photos have a world in any unit, a model sees the unit of its training. The model runs on the inputs
at several factors, and the photos that it renders decide. Inputs alone mislead: at a factor that is
too small, surfaces close to the cameras render them well, so further photos are judged as well.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from qgs.containers import map_tensors
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.samples import Sample, make_sample
from qgs.domain import TOLERANCE, Domain
from qgs.geometry.poses import look_at_depth, scaled
from qgs.metrics.baselines import pose_distance
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.types import Views
from qgs.wording import listed

FURTHER = 2
"""Most photos that are judged with the inputs."""
STEP = 1.6
"""Ratio of neighbouring factors at first."""
MOST = 16
"""Most factors that are tried before the search refines."""
BASELINES = (0.06, 0.25)
"""Least and largest baseline if the training's are unknown."""
BELOW = 2.0
"""Factor by which the search goes below the least baseline of the training."""
ABOVE = 4.0
"""Factor by which the search goes above the largest baseline of the training."""
NEAREST = 0.8
"""Least depth that cameras look at if the training's is unknown."""
REACH = 6.0
"""The search brings what cameras look at to REACH times the least depth."""
PENALTY = 5.0
"""Penalty in dB per e-fold by which depths are below those of the training; for inputs alone."""
POOR = 14.0
"""PSNR in dB of the judged photos below which no scale fits; novel views then average 12 dB."""
PIXELS = 2**18
"""Most pixels of inputs in one forward pass; this limits memory."""


@dataclass(frozen=True)
class FoundScale:
    """The best factor of all translations, and the photos that it was found on.

    psnr: mean of the inputs and, counted twice, of the `further` photos, in dB. names: of their
    files. tried: each factor with its psnr.
    """

    factor: float
    psnr: float
    further: Frames
    names: Sequence[str]
    tried: Sequence[tuple[float, float]]

    @property
    def poor(self) -> str:
        """Remark if no factor gave a good result or only inputs were judged, else ""."""
        # NaN is poor too.
        if not self.psnr >= POOR:
            return (
                f"no scale fits: the best gives only {self.psnr:.1f} dB; choose inputs that "
                "overlap more (frames), or give the scale"
            )
        if self.further:
            return ""
        return "inputs alone can mislead the search: add photos between them, or give the scale"

    @property
    def text(self) -> str:
        """Factor, photos and quality."""
        judged = f"the inputs and {listed(self.names)}" if self.names else "the inputs"
        return f"scale {self.factor:.3g}, found on {judged}: {self.psnr:.1f} dB"


def photo_settings(views: ViewsConfig, own: bool, overrides: Sequence[str] = ()) -> ViewsConfig:
    """Return `views` for photos of a user: `search` for a constant scale not set for them.

    own: whether the model was trained on these photos. overrides: settings of `views`.
    """
    known = own or any(text.startswith("views.scale") for text in overrides)
    search = views.scale == "constant" and not known
    return views.model_copy(update={"scale": "search"}) if search else views


def constant_scale(views: ViewsConfig, factor: float) -> ViewsConfig:
    """Return `views` with this factor of all translations."""
    return views.model_copy(update={"scale": "constant", "scale_factor": factor})


@torch.no_grad()
def find_scale(
    model: QueryGaussianModel, scene: Scene, inputs: Frames, compared: Frames, views: ViewsConfig
) -> FoundScale:
    """Search the factor at which `model` renders inputs and `further_photos` of `scene` best.

    Factors STEP apart cover what the trained ranges allow, and more past an end that is best;
    thirds of a step lie around the best, and the last one is the vertex of a parabola in log scale.
    Without further photos one of three or more inputs is judged and not given to the model; of two,
    factors that bring what the cameras look at nearer than in training lose PENALTY. model: in
    evaluation mode; the search runs where it is.
    """
    given = tuple(inputs)
    further = further_photos(scene, inputs, compared)
    if not further and len(given) > 2:
        further = (given[len(given) // 2],)
        given = tuple(frame for frame in given if frame not in further)
    sample = make_sample(scene, given, further, constant_scale(views, 1.0), mirror=False)
    frames = given if len(given) > 1 else given + further
    low, high, nearest = search_range(model.trained_on or Domain(), scene, frames)
    # Even steps in log scale: what counts is the ratio to the right factor.
    count = min(math.ceil(math.log(high / low) / math.log(STEP)) + 1, MOST)
    ratio = (high / low) ** (1 / max(count - 1, 1))
    # Places are thirds of a step, so that the finer search lies between those of the first.
    trial = _Trial(model, sample, low, ratio ** (1 / 3), 0.0 if further else nearest)
    best = trial.best(range(0, 3 * count, 3))
    if ratio > 1:
        while (end := trial.past(best)) and len(trial.tried) < MOST:
            best = trial.best(end)
        best = trial.best([best + place for place in (-2, -1, 1, 2)])
        best = trial.best([best + trial.vertex(best)])
    return FoundScale(
        factor=trial.factor(best),
        psnr=trial.psnr(best),
        further=further,
        names=[scene.frame_name(frame) for frame in further],
        tried=sorted((trial.factor(place), trial.psnr(place)) for place in trial.tried),
    )


def further_photos(scene: Scene, inputs: Frames, compared: Frames) -> Frames:
    """Return at most FURTHER photos from the middle of the inputs, without held-out ones.

    Photos to compare with are left out too. The middle is where the largest `pose_distance` from
    the inputs is smallest. Scenes that move have no such photos.
    """
    left = [f for f in range(len(scene)) if f not in {*inputs, *compared, *scene.held_out}]
    if scene.times is not None or not left:
        return ()
    c2w = scene.cameras.c2w.double()
    far = pose_distance(c2w[None, list(inputs)], c2w[None, left])[0].amax(1).tolist()
    return tuple(sorted(frame for _, frame in sorted(zip(far, left, strict=True))[:FURTHER]))


def search_range(trained: Domain, scene: Scene, frames: Frames) -> tuple[float, float, float]:
    """Return both ends of the search, and the least factor at which depths are as in training.

    The last is 0 where the depth that the cameras look at is unknown.
    """
    depth = float(look_at_depth(scene.cameras.c2w))
    centres = scene.cameras.c2w[list(frames), :3, 3].double()
    baseline = float(torch.cdist(centres, centres).max())
    found: list[float] = []
    low, high = trained.ranges.get("baseline", BASELINES)
    if baseline > 0 and high > 0:
        # A training may have seen baselines near 0, which no search needs to reach.
        found += [max(low, high / 10) / baseline / BELOW, high / baseline * ABOVE]
    near = trained.ranges.get("depth", (NEAREST, math.inf))[0]
    near = near if 0 < near < math.inf else NEAREST
    nearest = 0.0
    if depth > 0:
        found += [near / TOLERANCE / depth, near * REACH / depth]
        nearest = near * TOLERANCE / depth
    # Cameras on one point leave nothing to search: no factor changes what they see.
    return min(found, default=1.0), max(found, default=1.0), nearest


@dataclass
class _Trial:
    """PSNR of `sample`, whose factor is 1, at the factors low * step ** place.

    tried: means of inputs and of further photos by place. nearest: a factor below which PENALTY
    goes off the score.
    """

    model: QueryGaussianModel
    sample: Sample
    low: float
    step: float
    nearest: float
    tried: dict[float, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        device = next(self.model.parameters()).device
        self.inputs = self.sample.inputs.to(device)
        self.further = self.sample.targets.to(device)

    def factor(self, place: float) -> float:
        return self.low * self.step**place

    def psnr(self, place: float) -> float:
        # Photos that are not given count twice: inputs alone mislead.
        own, further = self.tried[place]
        return own if math.isnan(further) else (own + 2 * further) / 3

    def score(self, place: float) -> float:
        below = self.nearest / self.factor(place)
        found = self.psnr(place) - PENALTY * math.log(max(below, 1.0))
        return -math.inf if math.isnan(found) else found

    def best(self, places: Sequence[float]) -> float:
        """Try these places; return the best of all so far."""
        new = [place for place in places if place not in self.tried]
        each = max(PIXELS // self.inputs.images[:, :, 0].numel(), 1)
        for start in range(0, len(new), each):
            part = new[start : start + each]
            factors = self.inputs.images.new_tensor([self.factor(place) for place in part])
            gaussians = self.model(at_factors(self.inputs, factors)).gaussians
            columns = []
            for views in (self.inputs, self.further):
                cameras = at_factors(views, factors).cameras
                empty = not views.images.shape[1]
                seen = views.images if empty else self.model.render(gaussians, cameras).rgb
                columns.append(psnr(seen, views.images).mean(1).expand(len(part)).tolist())
            self.tried.update(zip(part, zip(*columns, strict=True), strict=True))
        return max(self.tried, key=self.score)

    def past(self, place: float) -> Sequence[float]:
        """Return places past the ends of those tried where `place` is such an end, else none."""
        if place == min(self.tried):
            return [place - 6, place - 3]
        return [place + 3, place + 6] if place == max(self.tried) else []

    def vertex(self, place: float) -> float:
        """Return the offset from `place` to the vertex of the parabola through three scores."""
        if not {place - 1, place + 1} <= self.tried.keys():
            return 0.0
        left, middle, right = (self.score(place + side) for side in (-1, 0, 1))
        bend = left - 2 * middle + right
        return 0.5 * (left - right) / bend if bend < 0 else 0.0


def at_factors(views: Views, factors: Tensor) -> Views:
    """Return views (1, V) as (F, V), with translations multiplied by each of `factors` (F,)."""
    many = map_tensors(lambda tensor: tensor.expand(len(factors), *tensor.shape[1:]), views)
    c2w = scaled(many.cameras.c2w, factors[:, None])
    return replace(many, cameras=replace(many.cameras, c2w=c2w))
