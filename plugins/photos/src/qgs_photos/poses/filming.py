"""`qgs video` and --video: what is filmed, from where, how large and how long."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress

from qgs.checkpoint.gaussians import load_ply
from qgs.contracts import Renderer
from qgs.data.recognition import open_for
from qgs.files import refuse_existing
from qgs.geometry.poses import relative_to, scaled
from qgs.geometry.transforms import moved
from qgs.reconstruction.result import Reconstruction
from qgs.reconstruction.scenes import installed_sources, named_scene
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Gaussians
from qgs_photos.poses.film import pictures, refuse_suffix, write_film
from qgs_photos.poses.paths import KINDS, path_of, read_path

_HEIGHT = 480  # pixels of the shorter side by default


@dataclass(frozen=True)
class Shot:
    """How a scene is filmed. path: of KINDS, or a file. size: (H, W). fov: vertical, in degrees."""

    path: str = "orbit"
    size: tuple[int, int] | None = None
    seconds: float = 8.0
    rate: int = 24
    fov: float | None = None


@dataclass(frozen=True)
class Stage:
    """Gaussians (1, G) and the cameras (1, V) of photos of them, in one world.

    photos: from the photos' world to that one, the pose (4, 4) of its reference camera and scale.
    """

    gaussians: Gaussians
    cameras: Cameras
    renderer: Renderer
    photos: tuple[torch.Tensor, float]


def film_reconstruction(file: Path, path: str) -> Callable[[Reconstruction, Console], Path]:
    """What films the result of `qgs reconstruct`, as --video and --path ask; see `film`.

    Raises FileExistsError and ValueError at once, before anything is reconstructed.
    """
    refuse_existing(file)
    refuse_suffix(file)
    if path not in KINDS:
        read_path(Path(path), (_HEIGHT, _HEIGHT), None)

    def filmed(result: Reconstruction, console: Console) -> Path:
        (reference, scale), renderer = result.world, result.model.renderer
        cameras, world = result.sample.inputs.cameras, (reference.double(), float(scale))
        film(Stage(result.gaussians, cameras, renderer, world), Shot(path), file, console)
        return file

    return filmed


def film(stage: Stage, shot: Shot, file: Path, console: Console) -> None:
    """Render the path and write `file`. Raises ValueError for a path that is none."""
    path = cameras_of(stage, shot).to(stage.gaussians.means.device)
    count = path.shape[1]
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("rendering", total=count)

        def progress(done: int) -> None:
            bar.update(task, completed=done)

        frames = pictures(stage.gaussians, path, stage.renderer, progress)
        write_film(frames, file, shot.rate)


def cameras_of(stage: Stage, shot: Shot) -> Cameras:
    """The cameras (1, T) of the path, of the wanted size and angle of view."""
    own = stage.cameras.size
    factor = max(_HEIGHT / min(own), 1) if min(own) < _HEIGHT else 1.0
    size = shot.size or (round(own[0] * factor / 2) * 2, round(own[1] * factor / 2) * 2)
    count = max(round(shot.seconds * shot.rate), 2)
    if shot.path not in KINDS:
        c2w, lens = read_path(Path(shot.path), size, shot.fov)
        reference, scale = stage.photos
        c2w = scaled(relative_to(reference, c2w), scale)
        return Cameras(c2w.float()[None], lens.float()[None], size)
    path = path_of(shot.path, stage.cameras, seen_depth(stage), count)
    return Cameras(path.c2w, lenses(path, size, shot.fov), size)


def lenses(path: Cameras, size: tuple[int, int], fov: float | None) -> torch.Tensor:
    """Intrinsics (1, T, 4) at another size and angle of view, centred."""
    height, width = size
    fx, fy, _, _ = path.intrinsics.unbind(-1)
    if fov is not None:
        focal = torch.full_like(fy, height / 2 / math.tan(math.radians(fov) / 2))
        fx = fy = focal
    else:  # all of the shorter side is seen
        factor = max(height / path.size[0], width / path.size[1])
        fx, fy = fx * factor, fy * factor
    middle = torch.full_like(fx, width / 2), torch.full_like(fx, height / 2)
    return torch.stack([fx, fy, *middle], -1)


@torch.no_grad()
def seen_depth(stage: Stage) -> float:
    """The median depth of what the first, the middle and the last camera see."""
    count = stage.cameras.shape[1]
    rendered = stage.renderer(stage.gaussians, stage.cameras[:, [0, count // 2, count - 1]])
    seen = rendered.depth[rendered.alpha > 0.5]
    return float(seen.median()) if seen.numel() else 1.0


def open_stage(source: Path, photos: str | None, scene: str | None) -> Stage:
    """The scene in a folder of `qgs reconstruct` or `qgs scene`, or in a PLY file, with its photos.

    photos: of the scene, where `source` does not hold their cameras. Raises ValueError without.
    """
    record = source / "cameras.json"
    if record.is_file() and (source / "gaussians.ply").is_file():
        return _of_reconstruction(load_ply(source / "gaussians.ply"), record)
    file = source / "scene.ply" if source.is_dir() else source
    if not file.is_file():
        raise FileNotFoundError(
            f"{source} is no PLY file and has neither gaussians.ply with cameras.json nor "
            "scene.ply: give what `qgs reconstruct` or `qgs scene` wrote"
        )
    if photos is None:
        raise ValueError(f"{file} holds no cameras: add the photos, as `qgs video {source} PHOTOS`")
    gaussians = load_ply(file)
    cameras = _cameras(photos, scene)
    # near and far of renderers are made for worlds in which what is seen is about 1 away
    reference, scale = cameras.c2w[0].double(), 1 / _median_depth(gaussians, cameras)
    inside = scaled(relative_to(reference, cameras.c2w.double()), scale)
    there = Cameras(inside.float()[None], cameras.intrinsics.float()[None], cameras.size)
    gaussians = moved(gaussians, scaled(torch.linalg.inv(reference), scale), scale)
    background = _background(source.parent if source.is_file() else source)
    return Stage(gaussians, there, AutoRenderer(background), (reference, scale))


def _cameras(photos: str, name: str | None) -> Cameras:
    """Those of all photos, at their stored size."""
    sources = installed_sources()
    scene = named_scene(open_for(photos, None, None, sources)[0], photos, name)
    if stored := scene.stored_size(0):
        scene = named_scene(open_for(photos, stored, None, sources)[0], photos, name)
    return scene.cameras


def _median_depth(gaussians: Gaussians, cameras: Cameras) -> float:
    """Of Gaussians before the first camera."""
    w2c = torch.linalg.inv(cameras.c2w[0].double())
    depths = gaussians.means[0].double() @ w2c[2, :3] + w2c[2, 3]
    ahead = depths[depths > 0]
    return float(ahead.median()) if ahead.numel() else 1.0


def _background(folder: Path) -> AutoRenderer.Config:
    """The renderer's options of what `qgs scene` wrote, else the default ones."""
    try:
        given = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["background"]
        return AutoRenderer.Config.model_validate({"background": tuple(given)})
    except (OSError, ValueError, KeyError, TypeError):
        return AutoRenderer.Config()


def _of_reconstruction(gaussians: Gaussians, record: Path) -> Stage:
    try:
        data: dict[str, Any] = json.loads(record.read_text(encoding="utf-8"))
        views = [view for view in data["views"] if view["kind"] == "input"]
        c2w = torch.tensor([view["c2w"] for view in views])
        lens = torch.tensor([view["intrinsics"] for view in views])
        height, width = views[0]["size"]
        cameras = Cameras(c2w[None], lens[None], (height, width))
        world = data["to_photos"]
        reference = torch.tensor(world["reference_c2w"], dtype=torch.float64)
        given = {"background": tuple(data["background"])} if data.get("background") else {}
        renderer = AutoRenderer(AutoRenderer.Config.model_validate(given))
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{record} is no record of a reconstruction ({type(error).__name__}: {error}): make it "
            "again with `qgs reconstruct`"
        ) from error
    return Stage(gaussians, cameras, renderer, (reference, float(world["scale"])))
