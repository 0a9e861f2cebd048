"""Run `qgs scene`: make the best scene of Gaussians from photos that a given time allows."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import torch
from rich.console import Console

from qgs.containers import concatenated
from qgs.data.photos.finding import is_inside
from qgs.data.photos.source import PhotoScene
from qgs.data.samples import views_in
from qgs.paths import opened_path
from qgs.reconstruction.scene_formats import writer_of
from qgs.renderers import AutoRenderer
from qgs.terminal import print_lines
from qgs.train.distributed import stop_requests
from qgs.types import Gaussians, Views, World
from qgs_photos.datatools.check import faults_of_poses
from qgs_photos.datatools.findings import Finding
from qgs_photos.refine.adjusting import DIFFER, brightness
from qgs_photos.refine.budget import TIMED, Budget
from qgs_photos.refine.earlier import chosen_start
from qgs_photos.refine.evidence import MOST, evidence
from qgs_photos.refine.initial import photos_start
from qgs_photos.refine.metric import Point, in_metres, metres, points_of
from qgs_photos.refine.options import Options
from qgs_photos.refine.refining import RefinedScene, refine, seconds_of_step
from qgs_photos.refine.result import Result, has_viewer, write_scene
from qgs_photos.refine.scene_photos import ScenePhotos
from qgs_photos.refine.surroundings import edge_color, surrounded
from qgs_photos.refine.sweeping import swept

END = 4.0
"""Seconds reserved for scores and files at the end."""
PART_OF_END = 0.03
"""Fraction of the total time that is reserved for scores and files, on top of END seconds."""
# Of the time for the optimisation, however long all else took.
_LEAST_PART = 0.1
# Photos that given poses are judged by, a second each.
_JUDGING = 4
SWEEP = 0.12
"""Fraction of the optimisation's time to spend on finding depths of pixels."""
BEGIN = 0.5
"""Part of the schedule that is left out if an earlier scene is optimised further."""


def make_scene(
    path: str, out: Path, options: Options, began: float, seconds: float, console: Console
) -> None:
    """Optimise a scene of the photos at `path`, score it, and write its files into `out`.

    began: time of `perf_counter` at the start. seconds: time from `began` to the last file.
    """
    # its remark comes first, before minutes of bars
    page = writer_of(out) is None and has_viewer(console)
    end = END + PART_OF_END * seconds

    def left() -> float:
        return options.seconds or max(began + seconds - end - perf_counter(), _LEAST_PART * seconds)

    photos = ScenePhotos(path, options)
    opened = perf_counter() - began
    with console.status("choosing a size for the time"):
        print_lines(console, map(str, faults_of_given_poses(photos)[:1]))
        world, given, options = chosen_start(photos, options)
        small = views_in(world, photos.small, photos.frames).to(options.device)
        # What masks leave out is empty, and black in viewers.
        color = (0.0, 0.0, 0.0) if options.masks else edge_color(small)
        renderer = AutoRenderer(AutoRenderer.Config(background=color))
        few, seconds_of_pixel = timed_sweep(small)
        options = with_exposure(options, few, small, console)
        step, compiling = seconds_of_step(few, small, renderer, options.extras)
        began += compiling  # once for each version of qgs, and not part of the time
        plan = Budget(step, small.cameras.size, photos, options)
        size = plan.affordable(left())
        scene = photos.at(size)
        points = points_of(options.scale_by, scene)  # refused before the minutes of optimisation
        count = plan.count(size)
        end += (min(len(photos.frames), MOST) + 3 * len(photos.held_out)) * plan.mean_step(size)
        every = views_in(world, scene, (*photos.frames, *photos.held_out)).to(options.device)
        every = masked(every) if options.masks else every
    budget = left()
    command = replace(options, size=size, gaussians=count, seconds=budget).command(path, str(out))
    # before the optimisation: an interrupted one can be repeated
    print_lines(console, [command, *plan.sentences(size, opened, budget)])
    most = int(SWEEP * budget / seconds_of_pixel)
    with console.status("placing Gaussians at pixels"):
        gaussians = given or photos_start(photos.small, world, small, count, most)
    refined = refine(
        gaussians,
        every.select(slice(len(photos.frames))),
        left(),
        count=count,
        # a model's Gaussians leave holes that pixels fill; the others are at pixels already
        swept=0.5 if options.frames else 0.0,
        renderer=renderer,
        console=console,
        extras=options.extras,
        begin=BEGIN if options.earlier else 0.0,
    )
    # Ctrl-C must not lose the scene
    with stop_requests(False), console.status("scoring held-out photos and writing files"):
        result = finished(command, world, refined, photos, every, color, options, points)
        write_scene(result, out, page, began, console)


def finished(
    command: str,
    world: World,
    refined: RefinedScene,
    photos: ScenePhotos,
    every: Views,
    color: Sequence[float],
    options: Options,
    points: tuple[Point, Point] | None,
) -> Result:
    """Return the result of an optimisation with surroundings, and without floaters.

    every: photos of the optimisation, then the held-out photos: (1, V). color: RGB of surroundings,
    which scenes with masks do not have. points: of the measured distance, if there is one.
    """
    optimised = refined.gaussians
    whole = optimised if options.masks else surrounded(optimised, every, color)
    around = whole.count - optimised.count
    views = every.select(slice(len(photos.frames)))
    judged = every.select(slice(len(photos.frames), None))
    found = evidence(whole, replace(views, cameras=refined.cameras), around)
    found = found.cleaned(judged).calibrated(judged)
    refined = replace(refined, gaussians=found.gaussians)
    count = found.gaussians.count - around
    factor = 1.0
    distance = options.scale_by
    if distance and points:
        # in the order of the photos
        frames = torch.tensor([*photos.frames, *photos.held_out]).argsort()
        cameras = concatenated([refined.cameras, judged.cameras], 1)[:, frames]
        factor = metres(points, distance[-1], found.gaussians[:, around:], cameras, world[1])
        world = in_metres(world, factor)
    return Result(command, count, world, refined, photos, views, judged, found, factor, distance)


def with_exposure(
    options: Options, gaussians: Gaussians, views: Views, console: Console
) -> Options:
    """Return `options` with the exposure of photos (1, V) adjusted if they differ, and say so.

    gaussians: (1, G) in the colours of their pixels. Options that choose what is adjusted are kept.
    """
    if options.extras.adjust is not None:
        return options
    spread = float(brightness(gaussians, views).nan_to_num().std(correction=0))
    adjust = "nothing"
    if spread > DIFFER:
        adjust = "exposure"
        print_lines(console, [f"brightness differs by {spread:.0%}: exposures are optimised"])
    return replace(options, extras=replace(options.extras, adjust=[adjust]))


def faults_of_given_poses(photos: ScenePhotos) -> Sequence[Finding]:
    """Return errors of poses that came with the photos; [] for poses computed by `qgs`."""
    path = opened_path(photos.path)
    # Poses of a video or of photos without cameras lie in a folder beside them.
    if isinstance(photos.small, PhotoScene) and not is_inside(path, photos.small.folder):
        return []
    return faults_of_poses(path, photos.name, _JUDGING)


def masked(views: Views) -> Views:
    """Return the views with black pixels outside of their masks.

    The optimisation then leaves these pixels without Gaussians. Raises ValueError for photos
    without masks.
    """
    if views.masks is None:
        raise ValueError("--masks needs photos with masks: leave --masks out, or add masks")
    return replace(views, images=views.masks * views.images)


def timed_sweep(views: Views) -> tuple[Gaussians, float]:
    """Return Gaussians (1, TIMED) at pixels of photos (1, V), and the seconds per Gaussian."""
    began = perf_counter()
    found = swept(views, TIMED, 1.0, torch.Generator().manual_seed(0))
    return found, (perf_counter() - began) / found.count
