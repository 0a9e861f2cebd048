"""Make the first Gaussians of `qgs scene`: by a model, or from the photos alone."""

import struct
from dataclasses import replace

import torch
from scipy.spatial import KDTree
from torch import Tensor
from upath import UPath

from qgs.checkpoint.model_file import load
from qgs.cli.options import scale_settings
from qgs.containers import concatenated
from qgs.contracts import Scene, ViewsConfig
from qgs.data.inputs import scene_depth
from qgs.data.photos import formats_of
from qgs.data.photos.source import PhotoScene
from qgs.data.samples import own_world
from qgs.paths import read_file
from qgs.recipe.registry import load_usable_plugins
from qgs.reconstruction.reconstruct import reconstruct
from qgs.types import Gaussians, Views, World
from qgs_photos.datasets.colmap import Colmap, read_lines
from qgs_photos.refine.budget import TIMED
from qgs_photos.refine.options import NONE, Options
from qgs_photos.refine.scene_photos import ScenePhotos
from qgs_photos.refine.sweeping import balls, swept
from qgs_photos.viewing import in_own_world

ENOUGH = 4
"""Least number of photos for which Gaussians at pixels are as good a start of the optimisation as
the Gaussians of a model."""
_OPACITY = 0.1
# Nearest points that give a size.
_NEIGHBOURS = 3
# Number, position, colour, error, length of the track.
_FIXED = struct.Struct("<Q3d3BdQ")


Start = tuple[World, Gaussians | None, Options]
"""Start of the optimisation: reference pose (4, 4) and scale of the world of the Gaussians, see
`own_world`; Gaussians (1, G), or None if they are to be placed from the photos; the options, with
the model, input frames and scale that made the Gaussians."""


def chosen_initialisation(photos: ScenePhotos, options: Options) -> Start:
    """Choose between a model and the photos alone as the start; if a model is chosen, run it.

    Without --model, --frames and --scale, the photos alone are chosen if there are at least ENOUGH
    of them; with fewer photos, a model is chosen. Raises ValueError for --frames or --scale with
    --model none, and if a model is needed but none is installed.
    """
    of_model = options.frames is not None or options.scale is not None
    if options.model == NONE and of_model:
        raise ValueError(
            "--frames and --scale need a model: leave out --frames and --scale, or leave out "
            "--model none"
        )
    enough = not of_model and len(photos.frames) >= ENOUGH
    if options.model == NONE or (options.model is None and enough):
        return photos_world(photos), None, replace(options, model=NONE)
    name = options.model or shipped_model()
    result = reconstruct(
        load(name, options.device),
        photos.path,
        frames=options.frames,
        compare=photos.held_out,
        scene=photos.name,
        overrides=scale_settings(options.scale),
    )
    inputs = ",".join(map(photos.small.frame_name, result.sample.input_frames))
    world = result.sample.world
    used = replace(options, model=name, frames=inputs, scale=float(world[1]))
    return world, result.gaussians, used


def shipped_model() -> str:
    """Return the name of a model that an installed plugin ships.

    Models of the plugin `worlds` come first, since they were trained for photos. Raises ValueError
    if no plugin ships a model.
    """
    registry, _ = load_usable_plugins()
    models = [pair for plugin in registry.plugins.values() for pair in plugin.models.items()]
    names = [name for name, file in models if file.is_file()]
    if not names:
        raise ValueError(
            "no trained model is installed: install query-gaussians-worlds, or name a model by "
            "--model"
        )
    return min(names, key=lambda name: (not name.startswith("worlds/"), name))


def photos_world(photos: ScenePhotos) -> World:
    """Return the world frame of the first camera, scaled so that the scene's depth is about 1.

    The result is the pose (4, 4) of this camera in the photos' world, and the scale: a point p of
    the frame is the point pose @ (p / scale) of the photos' world.
    """
    scale = 1 / scene_depth(photos.small)
    views = ViewsConfig(scale="constant", scale_factor=scale)
    return own_world(photos.small, photos.frames[:1], views)


def photos_start(scene: Scene, world: World, views: Views, count: int, most: int) -> Gaussians:
    """Return Gaussians (1, G) at COLMAP's points, if the scene has any, and at pixels of photos.

    world: reference pose (4, 4) and scale of the Gaussians' world, see `own_world`. views: photos
    (1, V). count: number of Gaussians at the end of the optimisation; the result has no more. most:
    largest number of Gaussians at pixels. Without COLMAP's points, there are at least TIMED
    Gaussians, whatever `count` and `most` are.
    """
    parts = list[Gaussians]()
    if isinstance(scene, PhotoScene) and (points := sparse_points(scene.folder)):
        # COLMAP's points are exact and few; pixels fill what they leave
        parts.append(from_points(points, world, count).to(views.images.device))
    left = min(count - sum(part.count for part in parts), most)
    pixels = max(left, 0 if parts else TIMED)
    if pixels:
        parts.append(swept(views, pixels, 1.0, torch.Generator().manual_seed(0)))
    return concatenated(parts, 1)


def sparse_points(folder: UPath) -> tuple[Tensor, Tensor] | None:
    """Return COLMAP's points: positions (N, 3) in the cameras' world, and colours (N, 3) in [0, 1].

    Both are float64. folder: folder of the scene. Returns None if the cameras are not from a COLMAP
    model, or if the model has no points. Raises ValueError for points that cannot be read.
    """
    # other formats go first, and have a world of their own
    if formats_of(folder)[:1] != ["colmap"]:
        return None
    model = Colmap.read(folder, None).file
    readers = {model / "points3D.bin": _binary, model / "points3D.txt": _text}
    file = next((file for file in readers if file.is_file()), None)
    if file is None:
        return None
    try:
        found = torch.tensor(readers[file](file), dtype=torch.float64)
    except (ValueError, struct.error) as error:
        raise ValueError(f"{file} cannot be read: {error}; export the model again") from error
    found = found.reshape(-1, 6)
    found = found[found.isfinite().all(1)]
    return (found[:, :3], found[:, 3:] / 255) if len(found) else None


def _text(file: UPath) -> list[list[float]]:
    return [[float(word) for word in line.split()[1:7]] for line in read_lines(file)]


def _binary(file: UPath) -> list[list[float]]:
    content = read_file(file)
    (count,) = struct.unpack_from("<Q", content)
    start = 8
    rows = list[list[float]]()
    for _ in range(count):
        _, *row, _, track = _FIXED.unpack_from(content, start)
        rows.append(row)
        # a track is a list of pairs of 4 bytes
        start += _FIXED.size + 8 * track
    if start > len(content):
        raise ValueError("the file is cut off")
    return rows


@torch.no_grad()
def from_points(points: tuple[Tensor, Tensor], world: World, most: int) -> Gaussians:
    """Return Gaussians (1, G) at points, each as large as the mean distance to its neighbours.

    points: positions and colours, see `sparse_points`. world: reference pose (4, 4) and scale of
    the Gaussians' world, see `own_world`. most: largest number of Gaussians; of more points, a
    random subset is used.
    """
    means, colors = points
    drawn = torch.randperm(len(means), generator=torch.Generator().manual_seed(0))[:most]
    means = means[drawn]
    # the nearest is the point itself
    near, _ = KDTree(means.numpy()).query(means.numpy(), _NEIGHBOURS + 1)
    gaps = torch.from_numpy(near).float()[:, 1:].mean(1)
    gaps = gaps.where(gaps.isfinite(), torch.nan)
    # a point that stands alone, or on others, is as large as the usual one
    middle = gaps.nanmedian().nan_to_num(1.0)
    gaps = gaps.nan_to_num(float(middle)).clamp(0.1 * middle, 5 * middle).clamp_min(1e-6)
    scales = gaps[:, None].expand(-1, 3)
    return in_own_world(world, balls(means, scales, _OPACITY, colors[drawn].float()))
