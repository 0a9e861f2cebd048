"""Refinement: Gaussians of one scene, optimised on its photos as 3D Gaussian splatting does.

Half of the predicted Gaussians are replaced by Gaussians on surfaces that the photos show, whose
depth is found by matching. On unfamiliar scenes a model leaves floaters and holes that gradient
steps, which are short, cannot repair.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import torch
import torch.nn.functional as F
from rich.console import Console
from torch import Tensor, nn

from qgs.containers import concatenated, map_tensors, named_tensors
from qgs.losses.photometric import mean_squared_error
from qgs.metrics.images import psnr
from qgs.renderers import AutoRenderer
from qgs.similarity import mean_ssim
from qgs.train.distributed import StopRequest, stop_requests
from qgs.train.tracking import TrainingProgress
from qgs.types import SH_COUNTS, Cameras, Gaussians, Views
from qgs_photos.refine.adjusting import Adjustments
from qgs_photos.refine.growth import FreeGaussians
from qgs_photos.refine.sweeping import swept

_RATES = {"means": 3.5e-3, "log_scales": 2e-2, "quats": 5e-3}  # of means: of the scene's size
_RATES |= {"opacity_logits": 0.05, "color_logits": 2.5e-2}
_RATES |= {"colors": 6e-3}  # beside `sh`: as the logits move a colour of one half
_RATES |= {"sh": 1.25e-3, "features": 0.0}  # a twentieth of the logits', as 3DGS; kept as they are
_LAST, _LAST_OF_MEANS = 0.1, 0.01  # final learning rates over the first
_SSIM = 0.25  # weight beside the mean squared error
# Weight of mean opacity and mean scale: at least the first, else the second over the number of
# photos, because few photos leave more freedom to fill space with fog.
_SMALL, _SMALL_OF_FEW = 0.06, 0.4
_GROWN, _SETTLED = 0.6, 0.8  # parts of the budget: growth is complete; relocation ends
_STEPS_BETWEEN_GROWTHS = 40
_LEVELS = ((4, 0.2), (2, 0.5), (1, 1.0))  # part of the resolution, up to this part of the budget
_LEAST_SIDE = 64  # pixels: no level is smaller
_POINTS = 12  # of the curve
_DEGREES_FROM = (0.1, 0.35, 0.6)  # part of the budget from which on a degree of harmonics is used


@dataclass(frozen=True)
class CurvePoint:
    """State of a refinement. psnr: dB, mean over the `compared` photos."""

    seconds: float
    step: int
    gaussians: int
    psnr: float


@dataclass(frozen=True)
class RefinedScene:
    """Refined Gaussians (1, G). curve: from the start on; empty without photos to compare with.

    seconds: of optimisation, without evaluations. cameras: (1, V) of the photos, corrected where
    that was wanted. stopped_by: the signal that ended it early.
    """

    gaussians: Gaussians
    curve: Sequence[CurvePoint]
    steps: int
    seconds: float
    cameras: Cameras
    stopped_by: str | None = None


@dataclass(frozen=True)
class Extras:
    """What is optimised beside means, shapes, opacities and colours.

    degree: spherical harmonics up to this degree, 0 to 3, grow with time where the start has none.
    exposure: an affine map of the colours of each photo. poses: the camera of each photo.
    """

    degree: int = 0
    exposure: bool = False
    poses: bool = False


NO_EXTRAS = Extras()


def refine(
    gaussians: Gaussians,
    views: Views,
    seconds: float,
    *,
    count: int | None = None,
    swept: float = 0.5,
    compared: Views | None = None,
    renderer: nn.Module | None = None,
    console: Console | None = None,
    extras: Extras = NO_EXTRAS,
) -> RefinedScene:
    """Optimise `gaussians` (1, G) on the photos `views` (1, V) of their scene.

    seconds: of optimisation, counted after the first step, in which kernels compile. count:
    Gaussians at the end, by default as many as given; they grow in the first part of the time.
    The optimisation starts from the most opaque of the given Gaussians and, as the part `swept` of
    all, from others at pixels, where the photos agree on a depth. compared: photos (1, W) for the
    curve, never optimised on, whose cameras stay. renderer: `qgs/auto` by default. console: where
    progress is shown; nowhere by default. extras: what else is optimised. The first Ctrl-C finishes
    the step and returns the result so far. Works in any world: its size is measured by the distance
    of the Gaussians from the cameras.

    Raises ValueError for more than one scene, no photo, no time, and Gaussians that are not finite.
    """
    wanted = gaussians.count if count is None else count
    _refuse_unusable(gaussians, views, seconds, wanted)
    quiet, stopping = console or Console(quiet=True), stop_requests(console is None)
    with TrainingProgress(quiet) as progress, stopping as stop, torch.enable_grad():
        renderer = renderer or AutoRenderer(AutoRenderer.Config())
        run = _Run(gaussians, views, seconds, wanted, renderer, swept, extras)
        curve = list(run.curve(compared, progress, stop))
        name = stop.signal.name if stop.signal else None
        refined = map_tensors(Tensor.detach, run.free.gaussians())
        cameras = run.adjustments.every_camera(views.cameras)
        return RefinedScene(refined, curve, run.step, run.spent, cameras, name)


def seconds_of_step(
    gaussians: Gaussians, views: Views, renderer: nn.Module, extras: Extras = NO_EXTRAS
) -> float:
    """Time of a step of `refine` with these Gaussians at the size of the photos `views` (1, V).

    The least of three, after one in which kernels compile, with all harmonics in use.
    """
    run = _Run(gaussians, views, math.inf, gaussians.count, renderer, 0.0, extras)
    run.levels, run.grows, times = run.levels[-1:], False, list[float]()
    with torch.enable_grad():
        for _ in range(4):
            began = perf_counter()
            run.optimise()
            times.append(perf_counter() - began)
    return min(times[1:])


class _Run:
    """One refinement: its Gaussians, photos by level of resolution, and clock."""

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        seconds: float,
        wanted: int,
        renderer: nn.Module,
        swept: float,
        extras: Extras = NO_EXTRAS,
    ) -> None:
        self.renderer, self.wanted, self.given, self.grows = renderer, wanted, gaussians, False
        self.generator, began = torch.Generator().manual_seed(0), perf_counter()
        side = min(views.cameras.size)
        levels = [level for level in _LEVELS if level[0] == 1 or side // level[0] >= _LEAST_SIDE]
        self.levels = [(resized(views, part), end) for part, end in levels]
        self.start = min(wanted, gaussians.count)
        gaussians = partly_swept(gaussians, self.levels[0][0], self.start, swept, self.generator)
        self.size, photos = distance(gaussians, views), views.images.shape[1]
        if extras.degree and gaussians.sh is None:
            zeros = gaussians.means.new_zeros(1, gaussians.count, SH_COUNTS[extras.degree - 1], 3)
            gaussians, self.grows = replace(gaussians, sh=zeros), True
        self.rates = {**_RATES, "means": _RATES["means"] * self.size}
        self.free = FreeGaussians(gaussians, self.rates)
        self.adjustments = Adjustments(
            photos, extras.poses, extras.exposure, self.size, gaussians.means
        )
        self.seconds, self.step, self.grown = seconds, 0, 0
        # half of the time is for steps, however long a slow machine matches photos
        self.spent = min(perf_counter() - began, seconds / 2)
        self.order: list[int] = []

    def curve(
        self, compared: Views | None, progress: TrainingProgress, stop: StopRequest
    ) -> Iterator[CurvePoint]:
        """Optimise until the time is used or a stop is requested; yield points of the curve."""
        if compared is not None:
            quality = mean_psnr(self.given, compared, self.renderer)
            yield CurvePoint(0.0, 0, self.given.count, quality)
        due = self.seconds / _POINTS
        while self.spent < self.seconds and not stop:
            if compared is not None and self.spent >= due:
                due = (self.spent // (self.seconds / _POINTS) + 1) * self.seconds / _POINTS
                yield self._point(compared)
            began = perf_counter()
            loss, quality = self.optimise()
            if self.step > 1:  # the first one compiles
                self.spent += perf_counter() - began
            used = self.spent / self.seconds
            progress.show(self.step, loss, quality, self.step, self.spent, used)
        if not stop and self.free.count < self.wanted:  # the budget was a few steps
            self.free.grow(self.wanted, self.generator)
        if compared is not None:
            yield self._point(compared)

    def _point(self, compared: Views) -> CurvePoint:
        quality = mean_psnr(self.free.gaussians(), compared, self.renderer)
        return CurvePoint(self.spent, self.step, self.free.count, quality)

    def optimise(self) -> tuple[float, float]:
        """One step on one photo, then growth if it is due; the loss and PSNR before the step."""
        used = min(self.spent / self.seconds, 1.0)
        for group in self.free.optimizer.param_groups:
            name = group["name"]
            group["lr"] = self.rates[name] * (_LAST_OF_MEANS if name == "means" else _LAST) ** used
        views = next(views for views, end in self.levels if used < end or end == 1)
        if not self.order:
            self.order = torch.randperm(views.images.shape[1], generator=self.generator).tolist()
        place = self.order.pop()
        photo = views.select([place])
        if self.grows:
            degrees = sum(used >= start for start in _DEGREES_FROM)
            self.free.active = (0, *SH_COUNTS)[degrees]
        gaussians = self.free.gaussians()
        cameras = self.adjustments.cameras(place, photo.cameras)
        rgb = self.renderer(replace(gaussians, features=None), cameras).rgb
        rgb = self.adjustments.seen(place, rgb)
        error = mean_squared_error(rgb, photo.images)
        loss = error + _SSIM * (1 - mean_ssim(rgb, photo.images, "same"))
        spread = gaussians.opacities.mean() + gaussians.scales.mean() / self.size
        loss = loss + max(_SMALL, _SMALL_OF_FEW / views.images.shape[1]) * spread
        loss = loss + self.adjustments.cost(place)
        self.free.optimizer.zero_grad()
        loss.backward()
        self.free.optimizer.step()
        self.adjustments.step(used)
        self.step += 1
        self._grow(used)
        return float(loss.detach()), -10 * math.log10(max(float(error.detach()), 1e-10))

    def _grow(self, used: float) -> None:
        """Relocate and add Gaussians if that is due; used: part of the budget spent so far."""
        regular = self.step - self.grown >= _STEPS_BETWEEN_GROWTHS and used < _SETTLED
        if regular or (used >= _GROWN and self.free.count < self.wanted):
            self.grown = self.step
            share = min(used / _GROWN, 1.0)
            now = round(self.start * (self.wanted / self.start) ** share)
            self.free.grow(now, self.generator)


def partly_swept(
    gaussians: Gaussians, views: Views, count: int, part: float, generator: torch.Generator
) -> Gaussians:
    """`count` Gaussians (1, count): the most opaque given ones, and a `part` swept from the photos.

    A single photo has no depth, so that all are given ones. Spherical harmonics and features of
    the swept ones are 0.
    """
    new = int(part * count) if views.images.shape[1] > 1 else 0
    kept = gaussians.most_opaque(count - new)
    if not new:
        return kept
    others = swept(views, new, distance(gaussians, views), generator)
    added = (("sh", kept.sh), ("features", kept.features))
    zeros = {k: x.new_zeros(1, new, *x.shape[2:]) for k, x in added if x is not None}
    return concatenated([kept, replace(others, **zeros)], 1)


def distance(gaussians: Gaussians, views: Views) -> float:
    """Median distance of Gaussians (1, G) from the nearest camera of `views` (1, V), above 0."""
    distances = torch.cdist(gaussians.means[0], views.cameras.c2w[0, :, :3, 3])
    return float(distances.amin(1).median().clamp_min(1e-6))


def resized(views: Views, part: int) -> Views:
    """The views at 1/part of their resolution, by means over areas."""
    if part == 1:
        return views
    height, width = views.cameras.size
    size = height // part, width // part
    images, masks = map_tensors(
        lambda x: F.interpolate(x[0], size=size, mode="area")[None], (views.images, views.masks)
    )
    factors = [size[1] / width, size[0] / height]
    intrinsics = views.cameras.intrinsics * views.cameras.intrinsics.new_tensor(factors * 2)
    cameras = Cameras(views.cameras.c2w, intrinsics, size)
    return replace(views, images=images, cameras=cameras, masks=masks)


@torch.no_grad()
def mean_psnr(gaussians: Gaussians, views: Views, renderer: nn.Module) -> float:
    """Mean PSNR in dB of renderings against `views` (1, V)."""
    rgb: Tensor = renderer(replace(gaussians, features=None), views.cameras).rgb
    return float(psnr(rgb[0], views.images[0]).mean())


def _refuse_unusable(gaussians: Gaussians, views: Views, seconds: float, count: int) -> None:
    given = (*gaussians.means.shape[:2], *views.images.shape[:2])
    if given[0] != 1 or given[2] != 1 or 0 in given or not seconds > 0 or count < 1:
        raise ValueError(
            "refinement takes Gaussians (1, G) and photos (1, V) of one scene; got {} scenes of "
            "{} Gaussians, {} scenes of {} photos".format(*given)
            + f", {seconds:g} seconds, count={count}: give at least one of each"
        )
    if not all(bool(tensor.isfinite().all()) for _, tensor in named_tensors(gaussians)):
        raise ValueError(
            "some Gaussians are not finite, so they cannot be refined: the model that predicted "
            "them is broken, or its photos are far from what it was trained on"
        )
