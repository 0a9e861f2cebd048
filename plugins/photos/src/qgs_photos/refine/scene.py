"""`qgs scene`: from photos to the files of the best scene in a given time."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter

import torch
from rich.console import Console

from qgs.data.samples import views_in
from qgs.renderers import AutoRenderer
from qgs.types import Gaussians, Views
from qgs_photos.printing import say
from qgs_photos.refine.initial import chosen_initialisation, photos_start
from qgs_photos.refine.options import Options
from qgs_photos.refine.refining import distance, joined, refine, seconds_of_step
from qgs_photos.refine.result import Result, page_writer, write_scene
from qgs_photos.refine.scene_photos import TIMED, ScenePhotos, affordable
from qgs_photos.refine.surroundings import surroundings
from qgs_photos.refine.sweeping import swept

END = 4.0
"""Seconds kept for scores and files."""
PART_OF_END = 0.03
"""Part of the time kept for them besides."""
# Of the time for the optimisation, however long all else took.
_LEAST_PART = 0.1
SWEEP = 0.12
"""Part of the time in which pixels get a depth."""


def make_scene(
    path: str, out: Path, options: Options, began: float, seconds: float, console: Console
) -> None:
    """Choose, optimise, judge and write.

    began: on the clock of `perf_counter`. seconds: for everything from then on.
    """
    # its remark comes first, before minutes of bars
    page = page_writer(console)
    ends = began + seconds - END - PART_OF_END * seconds

    def left() -> float:
        """Return the seconds that are left for the optimisation, or were given for it."""
        return options.seconds or max(ends - perf_counter(), _LEAST_PART * seconds)

    photos = ScenePhotos(path, options)
    start = chosen_initialisation(photos, options)
    small = views_in(start.world, photos.small, photos.frames).to(options.device)
    # what masks leave out stays empty, which viewers show black
    background = (0.0, 0.0, 0.0) if options.masks else backdrop(small)
    renderer = AutoRenderer(AutoRenderer.Config(background=background))
    few, seconds_of_pixel = timed_sweep(small)
    # on this machine, with these options: exposure and harmonics cost time too
    step = seconds_of_step(few, small, renderer, options.extras)
    size, count = affordable(step, small.cameras.size, photos, left(), options)
    frames = (*photos.frames, *photos.held_out)
    every = views_in(start.world, photos.at(size), frames).to(options.device)
    every = masked(every) if options.masks else every
    budget = left()
    command = replace(
        options,
        model=start.model,
        frames=start.frames,
        scale=float(start.world[1]) if start.frames else None,
        size=size,
        gaussians=count,
        seconds=budget,
    ).command(path, str(out))
    # before the optimisation: an interrupted one can be repeated
    say(console, command)
    most = int(SWEEP * budget / seconds_of_pixel)
    gaussians = start.gaussians or photos_start(photos.small, start.world, small, count, most)
    views = every.select(slice(len(photos.frames)))
    refined = refine(
        gaussians,
        views,
        left(),
        count=count,
        # a model's Gaussians leave holes that pixels fill; the others are at pixels already
        swept=0.0 if start.gaussians is None else 0.5,
        renderer=renderer,
        console=console,
        extras=options.extras,
    )
    if not options.masks:
        far = surroundings(every.cameras, distance(gaussians, views), background)
        refined = replace(refined, gaussians=joined(refined.gaussians, far))
    judged = every.select(slice(len(photos.frames), None))
    result = Result(command, start.world, refined, photos, views, judged)
    write_scene(result, out, page, began, console)


def masked(views: Views) -> Views:
    """Paint black what the photos' masks leave out, as viewers show it.

    What is empty is thereby seen to be empty. Raises ValueError for photos without masks.
    """
    if views.masks is None:
        raise ValueError("--masks: these photos have no masks: leave it out, or add masks")
    return replace(views, images=views.masks * views.images)


def timed_sweep(views: Views) -> tuple[Gaussians, float]:
    """Return some Gaussians (1, G) at pixels of photos (1, V), and the seconds of each."""
    began = perf_counter()
    found = swept(views, TIMED, 1.0, torch.Generator().manual_seed(0))
    return found, (perf_counter() - began) / found.count


def backdrop(views: Views) -> tuple[float, float, float]:
    """Return the median colour at photos' edges: what is there need not be made of Gaussians."""
    pixels = views.images[0].transpose(0, 1)
    edges = [pixels[..., 0, :], pixels[..., -1, :], pixels[..., 0], pixels[..., -1]]
    red, green, blue = torch.cat(edges, -1).flatten(1).median(1).values.tolist()
    return red, green, blue
