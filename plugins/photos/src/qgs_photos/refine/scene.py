"""`qgs scene`: from photos to the files of the best scene in a given time."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from qgs.checkpoint.gaussians import save_ply, save_splat
from qgs.containers import concatenated
from qgs.contracts import Scene, ViewsConfig
from qgs.data.depth import scene_depth
from qgs.data.photos.source import PhotoScene
from qgs.data.samples import own_world, views_in
from qgs.drawing import images
from qgs.drawing.figures import figure_picture, grid_figure
from qgs.drawing.images import rgb_picture
from qgs.extensions import INSTALL_ALL
from qgs.files import replacing_entries, write_text
from qgs.geometry.transforms import moved
from qgs.metrics.baselines import nearest_input
from qgs.metrics.images import psnr, ssim
from qgs.reconstruction.scenes import Size
from qgs.renderers import AutoRenderer
from qgs.types import Gaussians, Views
from qgs_photos.refine.plain import plain
from qgs_photos.refine.planning import (
    NONE,
    Plan,
    Scenes,
    Start,
    affordable,
    best_start,
    shipped_models,
)
from qgs_photos.refine.points import from_points, sparse_points
from qgs_photos.refine.refining import NO_EXTRAS, Extras, RefinedScene, refine, seconds_of_step
from qgs_photos.refine.sweeping import swept

END, PART_OF_END = 4.0, 0.03
"""Seconds, and part of the time, kept for scores and files."""
_LEAST_PART = 0.1  # of the time for the optimisation, however long all else took
ENOUGH = 4
"""Photos from which on a start at their pixels is as good as a model's, see docs/refine.md."""
SWEEP, TIMED = 0.12, 2048
"""Part of the time in which pixels get a depth, and how many of them are timed."""
_SHOWN = 6  # held-out photos in the picture


@dataclass(frozen=True)
class Wanted:
    """Options of `qgs scene`; None where it chooses."""

    model: str | None = None
    frames: str | None = None
    scale: float | None = None
    size: Size | None = None
    gaussians: int | None = None
    seconds: float | None = None
    holdout: str = "8"
    scene: str | None = None
    device: str = "cpu"
    extras: Extras = NO_EXTRAS
    masks: bool = False


def make_scene(
    photos: str, out: Path, wanted: Wanted, began: float, seconds: float, console: Console
) -> None:
    """Choose, optimise, judge and write. began, seconds: on the clock of `perf_counter`."""
    page = _page_writer(console)
    scenes = Scenes(photos, wanted.scene, wanted.holdout, wanted.frames, wanted.scale)

    def left() -> float:
        rest = seconds - (perf_counter() - began) - END - PART_OF_END * seconds
        return wanted.seconds or max(rest, _LEAST_PART * seconds)

    start = chosen_start(scenes, wanted, left(), console)
    renderer = AutoRenderer(AutoRenderer.Config(background=backdrop(scenes.probe, scenes.frames)))
    probe = views_in(start.world, scenes.probe, scenes.frames).to(wanted.device)
    few, of_pixel = timed_sweep(probe)
    seconds_of_one = seconds_of_step(few, probe, renderer, wanted.extras)
    timed = seconds_of_one, probe.cameras.size, few.count
    size, count = affordable(*timed, scenes, left(), (wanted.size, wanted.gaussians))
    both = views_in(start.world, scenes.at(size), (*scenes.frames, *scenes.held))
    both, photos_count = both.to(wanted.device), len(scenes.frames)
    if wanted.masks:
        both = masked(both, renderer.config.background)
    views, judged = both.select(slice(photos_count)), both.select(slice(photos_count, None))
    budget, scale = left(), float(start.world[1])
    plan = Plan(start.model, start.frames, scale, size, count, budget, wanted.holdout)
    plan = replace(plan, extras=wanted.extras, masks=wanted.masks)
    command = plan.command(photos, str(out), wanted.scene)
    console.print(command, soft_wrap=True, highlight=False, markup=False)
    gaussians, part = start.gaussians, 0.5
    if gaussians is None:
        sweeping, part = perf_counter(), 0.0
        most = int(SWEEP * budget / of_pixel)
        gaussians = photos_start(scenes.probe, start.world, probe, count, most)
        budget = max(budget - (perf_counter() - sweeping), _LEAST_PART * budget)
    refined = refine(
        gaussians, views, budget, count=count, swept=part, renderer=renderer, console=console,
        extras=wanted.extras,
    )  # fmt: skip
    made = Made(start, refined, renderer, scenes, views, judged, command)
    write_scene(made, out, page, began, console)


def chosen_start(scenes: Scenes, wanted: Wanted, seconds: float, console: Console) -> Start:
    """The photos alone where there are ENOUGH, unless a model or its options are wanted.

    Raises ValueError for options of a model that is not wanted.
    """
    of_model = wanted.frames is not None or wanted.scale is not None
    if wanted.model == NONE and of_model:
        raise ValueError("--frames and --scale are of a model: leave them out, or --model none")
    enough = not of_model and len(scenes.frames) >= ENOUGH
    if wanted.model == NONE or (wanted.model is None and enough):
        return Start(NONE, photos_world(scenes))
    models = [wanted.model] if wanted.model else shipped_models()
    return best_start(scenes, models, seconds, wanted.device, console)


def photos_world(scenes: Scenes) -> tuple[Tensor, Tensor]:
    """A world as of `own_world`, of the first camera, in which what photos show is about 1 away."""
    scale = 1 / scene_depth(scenes.probe)
    views = ViewsConfig(scale="constant", scale_factor=scale)
    return own_world(scenes.probe, scenes.frames[:1], views)


def photos_start(
    scene: Scene, world: tuple[Tensor, Tensor], views: Views, count: int, most: int
) -> Gaussians:
    """Gaussians (1, G): COLMAP's points where the scene has some, the others at pixels.

    count: of all at the end. most: at pixels, of the photos `views` (1, V), at least TIMED.
    """
    points = sparse_points(scene.folder) if isinstance(scene, PhotoScene) else None
    parts = list[Gaussians]()
    if points is not None:
        parts.append(from_points(points, world, count).to(views.images.device))
    many = max(min(count - sum(part.count for part in parts), most), 0 if parts else TIMED)
    if many:
        parts.append(swept(views, many, 1.0, torch.Generator().manual_seed(0)))
    return concatenated(parts, 1)


def masked(views: Views, background: Sequence[float]) -> Views:
    """The photos with the background in place of what their masks leave out.

    What is empty is thereby seen to be empty. Raises ValueError for photos without masks.
    """
    if views.masks is None:
        raise ValueError("--masks: these photos have no masks: leave it out, or add masks")
    color = views.images.new_tensor(background)[:, None, None]
    return replace(views, images=views.masks * views.images + (1 - views.masks) * color)


def timed_sweep(views: Views) -> tuple[Gaussians, float]:
    """Some Gaussians (1, G) at pixels of the photos `views` (1, V), and the seconds of each."""
    began = perf_counter()
    found = swept(views, TIMED, 1.0, torch.Generator().manual_seed(0))
    return found, (perf_counter() - began) / found.count


@dataclass(frozen=True)
class Made:
    """An optimised scene, photos `views` (1, V) optimised on, and `judged` (1, H) held-out ones."""

    start: Start
    refined: RefinedScene
    renderer: AutoRenderer
    scenes: Scenes
    views: Views
    judged: Views
    command: str

    def of_photos(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians (1, G) of its world in the frame and unit of the photos' cameras."""
        reference, scale = self.start.world
        return moved(gaussians, reference, 1 / float(scale))

    def label(self, frame: int) -> str:
        """The file of a photo."""
        return self.scenes.probe.frame_name(frame)


def backdrop(scene: Scene, frames: Sequence[int]) -> tuple[float, float, float]:
    """The median colour at the edges of photos: what is there need not be made of Gaussians."""
    few = frames[:: max(len(frames) // 16, 1)]
    pixels = scene.images(few)
    edges = [pixels[..., 0, :], pixels[..., -1, :], pixels[..., 0], pixels[..., -1]]
    red, green, blue = torch.cat(edges, -1).transpose(0, 1).flatten(1).median(1).values.tolist()
    return red, green, blue


@torch.no_grad()
def write_scene(made: Made, out: Path, page: Any, began: float, console: Console) -> None:
    """Write scene.ply, scene.splat, metrics.json, held_out.png and the page into `out`."""
    gaussians, photos = made.of_photos(made.refined.gaussians), made.judged
    shown = plain(made.refined.gaussians, made.refined.cameras)
    record = scores(made)
    with replacing_entries(out, "scene.ply") as fresh:
        save_ply(gaussians, fresh / "scene.ply")
        save_splat(made.of_photos(shown), fresh / "scene.splat")
        if made.scenes.held:
            pictures = held_out_picture(made, record["held_out"])
            images.write_png(pictures, fresh / "held_out.png")
        if page:
            views = replace(made.views, cameras=made.refined.cameras)
            few = views.select(slice(None, None, max(len(made.scenes.frames) // 12, 1)))
            background = made.renderer.config.background
            write_text(fresh / "index.html", page(shown, few, background))
        record["total_seconds"] = round(perf_counter() - began, 1)
        write_text(fresh / "metrics.json", json.dumps(record, indent=1))
        names = sorted(entry.name for entry in fresh.iterdir())
    mean, refined = record["mean"], made.refined
    ended = f", ended by {refined.stopped_by}" if refined.stopped_by else ""
    console.print(
        f"{refined.gaussians.count:,} Gaussians after {refined.steps:,} steps in "
        f"{refined.seconds:.0f} s on {len(made.scenes.frames)} photos{ended}",
        highlight=False,
    )
    if mean:
        console.print(
            f"{photos.images.shape[1]} held-out photos: PSNR {mean['psnr']:.2f} dB, SSIM "
            f"{mean['ssim']:.3f}; the nearest photo {mean['nearest_input']:.2f} dB",
            highlight=False,
        )
    for name in names:
        console.print(f"wrote {out / name}", soft_wrap=True, highlight=False, markup=False)


def scores(made: Made) -> dict[str, Any]:
    """What metrics.json holds: the command, the optimisation, PSNR and SSIM of held-out photos."""
    refined, rows = made.refined, list[dict[str, Any]]()
    for place, frame in enumerate(made.scenes.held):
        photo = made.judged.select([place])
        rgb = rendered(made, photo)
        nearest = nearest_input(made.views, photo.cameras)
        rows.append(
            {
                "frame": frame,
                "photo": made.label(frame),
                "psnr": float(psnr(rgb, photo.images).mean()),
                "ssim": float(ssim(rgb, photo.images).mean()),
                "nearest_input": float(psnr(nearest, photo.images).mean()),
            }
        )
    names = ("psnr", "ssim", "nearest_input") if rows else ()
    return {
        "command": made.command,
        "gaussians": refined.gaussians.count,
        "background": list(made.renderer.config.background),
        "steps": refined.steps,
        "seconds": round(refined.seconds, 1),
        "stopped_by": refined.stopped_by,
        "refined_on": [made.label(frame) for frame in made.scenes.frames],
        "mean": {name: sum(row[name] for row in rows) / len(rows) for name in names},
        "held_out": rows,
    }


def rendered(made: Made, photo: Views) -> torch.Tensor:
    """The scene as from the cameras of `photo` (1, V): (1, V, 3, H, W)."""
    gaussians = replace(made.refined.gaussians, features=None)
    return made.renderer(gaussians, photo.cameras).rgb


def held_out_picture(made: Made, rows: Sequence[Mapping[str, Any]]) -> images.Picture:
    """Some held-out photos over what was rendered of them."""
    chosen = range(0, len(rows), -(-len(rows) // _SHOWN))
    photos = [made.judged.select([place]) for place in chosen]
    titles = [f"{Path(rows[p]['photo']).name}\n{rows[p]['psnr']:.2f} dB" for p in chosen]
    pictures = {
        "photo": [rgb_picture(photo.images[0, 0]) for photo in photos],
        "render": [rgb_picture(rendered(made, photo)[0, 0]) for photo in photos],
    }
    return figure_picture(grid_figure(pictures, titles), 120)


def _page_writer(console: Console) -> Any:
    """The viewer's function that makes a page, imported now; None, with a remark, without it."""
    try:
        from qgs_viewer.page import gaussians_html

        return gaussians_html
    except ImportError:
        text = f"no page to turn the scene on, it needs query-gaussians-viewer: {INSTALL_ALL}"
        console.print(text, soft_wrap=True, highlight=False, markup=False)
        return None
