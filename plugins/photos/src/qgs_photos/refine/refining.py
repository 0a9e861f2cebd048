"""Refine the Gaussians of one scene: optimise them on its photos, as 3D Gaussian splatting does.

First, half of a model's Gaussians are replaced by Gaussians on surfaces whose depth is found by
matching photos. On scenes unlike its training data, a model leaves floaters and holes, which the
short steps of gradient descent cannot repair.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass
from time import perf_counter
from timeit import repeat

import torch
from rich.console import Console
from torch import Tensor, nn

from qgs.containers import concatenated, map_tensors, named_tensors
from qgs.data.samples import shrunk
from qgs.losses.photometric import mean_squared_error
from qgs.renderers import AutoRenderer
from qgs.similarity import mean_ssim
from qgs.train.distributed import StopRequest, stop_requests
from qgs.train.tracking import TrainingProgress
from qgs.types import SH_COUNTS, Cameras, Gaussians, Views
from qgs_photos.refine.adjusting import Adjustments
from qgs_photos.refine.growth import FreeGaussians
from qgs_photos.refine.sweeping import swept

_RATES = {
    # Of the scene's size.
    "means": 6e-3,
    "log_scales": 3.4e-2,
    "quats": 8.5e-3,
    "opacity_logits": 0.085,
    "colors": 1e-2,
    "sh": 2.1e-3,
    # Features are kept as they are.
    "features": 0.0,
}
# Final learning rates over the first. Rates begin with half, until this part of the budget.
_LAST = 0.5
_LAST_OF_MEANS = 0.05
_WARM = 0.15
# Part of the budget from which on values are averaged, because each step fits one photo.
_AVERAGED = 0.95
# Weight of SSIM beside the mean squared error.
_SSIM = 0.25
# Weight of mean opacity and mean scale: at least the first, else the second over the number of
# photos, because few photos leave more freedom to fill space with fog.
_SMALL = 0.06
_SMALL_OF_FEW = 0.4
# Weight of squares of what lies outside of 0 to 1 in colours (without their harmonics), which .spz,
# .splat and many viewers cannot hold.
_OUTSIDE = 10.0
# Part of the budget at which growth is complete.
_GROWN = 0.6
# Part of the budget at which relocation ends.
_SETTLED = 0.8
_STEPS_BETWEEN_GROWTHS = 40
# Part of the resolution, up to this part of the budget: coarse levels move Gaussians farther.
_LEVELS = ((4, 0.2), (2, 0.5), (1, 1.0))
# No level is smaller, in pixels: SSIM and the sweep need some.
_LEAST_SIDE = 64


@dataclass(frozen=True)
class RefinedScene:
    """Result of a refinement.

    gaussians: (1, G). steps, seconds: length of the optimisation. cameras: (1, V) of the photos,
    optimised if `Extras.adjust` has "poses". stopped_by: name of the signal that ended the
    optimisation early; None if it was complete.
    """

    gaussians: Gaussians
    steps: int
    seconds: float
    cameras: Cameras
    stopped_by: str | None = None


@dataclass(frozen=True)
class Extras:
    """Quantities to optimise in addition to means, shapes, opacities and colours of the Gaussians.

    degree: spherical harmonics up to this degree, 0 to 3, are added if the first Gaussians have
    none; 0 adds none. adjust: properties of each photo: "poses", its camera, and "exposure", an
    affine map of its colours. Other words have no effect; None leaves the choice to `qgs scene`.
    """

    degree: int = 0
    adjust: Collection[str] | None = None


NO_EXTRAS = Extras()


def refine(
    gaussians: Gaussians,
    views: Views,
    seconds: float,
    *,
    count: int | None = None,
    swept: float = 0.5,
    renderer: nn.Module | None = None,
    console: Console | None = None,
    extras: Extras = NO_EXTRAS,
    begin: float = 0.0,
) -> RefinedScene:
    """Optimise `gaussians` (1, G) on the photos `views` (1, V) of their scene.

    The optimisation starts from the most opaque of the given Gaussians, and from new Gaussians at
    pixels, at the depth on which photos agree. Positions may have any unit. The first Ctrl-C
    finishes the step and returns the result so far.

    seconds: time of the optimisation, without the first step, in which kernels compile. count:
    number of Gaussians at the end, reached in the first part of the time; None keeps the given
    number. swept: fraction of new Gaussians at the start, from 0 to 1. renderer: by default
    `qgs/auto`. console: shows progress; None shows none. extras: further quantities to optimise.
    begin: part of the schedule to leave out at its start, from 0 to 1, for Gaussians that were
    optimised before; the schedule sets learning rates, resolution and number of Gaussians.

    Raises ValueError for more than one scene, no photo, no time, or Gaussians that are not finite.
    """
    wanted = gaussians.count if count is None else count
    _refuse_unusable(gaussians, views, seconds, wanted)
    renderer = renderer or AutoRenderer(AutoRenderer.Config())
    stopping = stop_requests(console is None)
    progress = TrainingProgress(console or Console(quiet=True))
    with progress, stopping as stop, torch.enable_grad():
        run = _Run(gaussians, views, seconds, wanted, renderer, swept, extras, begin)
        run.until_spent(progress, stop)
        return RefinedScene(
            gaussians=map_tensors(Tensor.detach, run.free.gaussians()),
            steps=run.step,
            seconds=run.spent,
            cameras=run.adjustments.every_camera(views.cameras),
            stopped_by=stop[0].name if stop else None,
        )


def seconds_of_step(
    gaussians: Gaussians, views: Views, renderer: nn.Module, extras: Extras
) -> tuple[float, float]:
    """Measure the seconds of a step of `refine` on these Gaussians and photos (1, V).

    Runs four steps. Returns the least time of the last three steps, and the additional time of the
    first step, in which kernels compile.
    """
    # at the end of the schedule
    run = _Run(gaussians, views, math.inf, gaussians.count, renderer, 0.0, extras, 1.0)
    with torch.enable_grad():
        first, *others = repeat(run.optimise, number=1, repeat=4)
    least = min(others)
    return least, first - least


class _Run:
    """A refinement in progress: Gaussians, photos at several resolutions, time spent."""

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        seconds: float,
        wanted: int,
        renderer: nn.Module,
        swept: float,
        extras: Extras,
        begin: float,
    ) -> None:
        began = perf_counter()
        self.renderer = renderer
        self.wanted = wanted
        self.seconds = seconds
        self.begin = begin
        self.generator = torch.Generator().manual_seed(0)
        side = min(views.cameras.size)
        self.levels = [
            (shrunk(views, part), end)
            for part, end in _LEVELS
            if part == 1 or (side // part >= _LEAST_SIDE and end > begin)
        ]
        self.start = min(wanted, gaussians.count)
        coarsest = self.levels[0][0]
        gaussians = partly_swept(gaussians, coarsest, self.start, swept, self.generator)
        self.size = distance(gaussians, views)
        if extras.degree and gaussians.sh is None:
            shape = (1, gaussians.count, SH_COUNTS[extras.degree - 1], 3)
            gaussians = gaussians.replace(sh=gaussians.means.new_zeros(shape))
        self.rates = {**_RATES, "means": _RATES["means"] * self.size}
        self.free = FreeGaussians(gaussians, self.rates)
        self.photos = views.images.shape[1]
        self.adjustments = Adjustments(self.photos, extras.adjust or (), self.size, gaussians.means)
        self.step = 0
        self.grown = 0
        # half of the time is for steps, however long a slow machine matches photos
        self.spent = min(perf_counter() - began, seconds / 2)
        self.order: list[int] = []

    def until_spent(self, progress: TrainingProgress, stop: StopRequest) -> None:
        """Take steps until the time is spent or a stop is requested."""
        while self.spent < self.seconds and not stop:
            began = perf_counter()
            loss, quality = self.optimise()
            # the first step compiles kernels
            if self.step > 1:
                self.spent += perf_counter() - began
            progress.show(self.step, loss, quality, self.spent / self.seconds)
        # a budget of a few steps ends before growth is due
        if not stop and self.free.count < self.wanted:
            self.free.grow(self.wanted, self.generator)
        self.free.settle()

    def optimise(self) -> tuple[float, float]:
        """Take a step on one photo, and add Gaussians if their next addition is due.

        Returns the loss and the PSNR before the step.
        """
        used = min(self.begin + (1 - self.begin) * self.spent / self.seconds, 1.0)
        warm = min(0.5 + 0.5 * used / _WARM, 1.0)
        for group in self.free.optimizer.param_groups:
            last = _LAST_OF_MEANS if group["name"] == "means" else _LAST
            group["lr"] = self.rates[group["name"]] * warm * last**used
        views = next(views for views, end in self.levels if used < end or end == 1)
        if not self.order:
            # each photo once before any comes again
            self.order = torch.randperm(self.photos, generator=self.generator).tolist()
        place = self.order.pop()
        photo = views.select([place])
        gaussians = self.free.gaussians()
        cameras = self.adjustments.cameras(place, photo.cameras)
        rgb = self.renderer(gaussians.replace(features=None), cameras).rgb
        rgb = self.adjustments.seen(place, rgb, photo.images)
        error = mean_squared_error(rgb, photo.images)
        spread = gaussians.opacities.mean() + gaussians.scales.mean() / self.size
        loss = error + _SSIM * (1 - mean_ssim(rgb, photo.images, "same"))
        loss = loss + max(_SMALL, _SMALL_OF_FEW / self.photos) * spread
        outside = gaussians.colors - gaussians.colors.clamp(0, 1)
        loss = loss + _OUTSIDE * outside.square().mean() + self.adjustments.cost(place)
        self.free.optimizer.zero_grad()
        loss.backward()
        self.free.optimizer.step()
        self.adjustments.step(used)
        self.step += 1
        # relocated and added every few steps
        regular = self.step - self.grown >= _STEPS_BETWEEN_GROWTHS and used < _SETTLED
        if regular or (used >= _GROWN and self.free.count < self.wanted):
            self.grown = self.step
            share = min(used / _GROWN, 1.0)
            now = round(self.start * (self.wanted / self.start) ** share)
            self.free.grow(now, self.generator)
        if used >= _AVERAGED:
            self.free.average()
        return loss.item(), -10 * math.log10(max(error.item(), 1e-10))


def partly_swept(
    gaussians: Gaussians, views: Views, count: int, part: float, generator: torch.Generator
) -> Gaussians:
    """Return the most opaque of the given Gaussians and new ones at pixels, together (1, count).

    part: fraction of new Gaussians, from 0 to 1. The depth of new Gaussians comes from a plane
    sweep; their spherical harmonics and features are 0. With a single photo, which gives no depth,
    there are no new Gaussians.
    """
    new = int(part * count) if views.images.shape[1] > 1 else 0
    # faint Gaussians of a model are fog, which hides more than it shows
    kept = gaussians.most_opaque(count - new)
    if not new:
        return kept
    return joined(kept, swept(views, new, distance(gaussians, views), generator))


def joined(gaussians: Gaussians, others: Gaussians) -> Gaussians:
    """Join two sets of Gaussians (1, G).

    If `gaussians` have spherical harmonics or features, `others` get zeros for them.
    """
    for name in ("sh", "features"):
        given = getattr(gaussians, name)
        if given is not None:
            zeros = given.new_zeros(1, others.count, *given.shape[2:])
            others = others.replace(**{name: zeros})
    return concatenated([gaussians, others], 1)


def distance(gaussians: Gaussians, views: Views) -> float:
    """Return the median distance of Gaussians (1, G) from the nearest camera, at least 1e-6."""
    distances = torch.cdist(gaussians.means[0], views.cameras.c2w[0, :, :3, 3])
    return float(distances.amin(1).median().clamp_min(1e-6))


def _refuse_unusable(gaussians: Gaussians, views: Views, seconds: float, count: int) -> None:
    scenes, given = gaussians.means.shape[:2]
    photographed, photos = views.images.shape[:2]
    if scenes != 1 or photographed != 1 or not (given and photos and seconds > 0 and count > 0):
        raise ValueError(
            "refinement takes Gaussians (1, G) and photos (1, V) of one scene; got "
            f"{scenes} scenes of {given} Gaussians, {photographed} scenes of {photos} photos, "
            f"{seconds:g} seconds, count={count}: give one scene with at least one Gaussian and "
            "one photo, and positive seconds and count"
        )
    if not all(bool(tensor.isfinite().all()) for _, tensor in named_tensors(gaussians)):
        raise ValueError(
            "some Gaussians are NaN or infinite and cannot be refined: the model that predicted "
            "them is broken, or its photos are unlike its training data; use another model"
        )
