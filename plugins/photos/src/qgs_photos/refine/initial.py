"""Where the optimisation of `qgs scene` begins: a model's Gaussians, or some at the photos."""

from dataclasses import dataclass

import torch
from torch import Tensor

from qgs.checkpoint.model_file import load
from qgs.cli.options import scale_settings
from qgs.containers import concatenated
from qgs.contracts import Scene, ViewsConfig
from qgs.data.depth import scene_depth
from qgs.data.photos.source import PhotoScene
from qgs.data.samples import own_world
from qgs.recipe.registry import load_usable_plugins
from qgs.reconstruction.reconstruct import reconstruct
from qgs.types import Gaussians, Views
from qgs_photos.refine.options import NONE, Options
from qgs_photos.refine.points import from_points, sparse_points
from qgs_photos.refine.scene_photos import TIMED, ScenePhotos
from qgs_photos.refine.sweeping import swept

ENOUGH = 4
"""Photos from which on a start at their pixels is as good as a model's, see docs/refine.md."""


@dataclass(frozen=True)
class Initialisation:
    """A model's Gaussians (1, G), or none for Gaussians at the photos, and their world.

    world: reference pose (4, 4) and scale, as of `own_world`. frames: names of the inputs, as text.
    """

    model: str
    world: tuple[Tensor, Tensor]
    gaussians: Gaussians | None = None
    frames: str | None = None


def chosen_initialisation(photos: ScenePhotos, options: Options) -> Initialisation:
    """Take the photos alone where there are ENOUGH, unless a model or its options are wanted.

    Raises ValueError for options of a model that is not wanted, and without a model.
    """
    of_model = options.frames is not None or options.scale is not None
    if options.model == NONE and of_model:
        raise ValueError("--frames and --scale are of a model: leave them out, or --model none")
    enough = not of_model and len(photos.frames) >= ENOUGH
    if options.model == NONE or (options.model is None and enough):
        return Initialisation(NONE, photos_world(photos))
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
    return Initialisation(name, result.world, result.gaussians, inputs)


def shipped_model() -> str:
    """Return a model that an installed plugin ships, one of worlds where there is one.

    Those were trained for photos. Raises ValueError for none.
    """
    registry, _ = load_usable_plugins()
    models = [pair for plugin in registry.plugins.values() for pair in plugin.models.items()]
    names = [name for name, file in models if file.is_file()]
    if not names:
        raise ValueError(
            "no trained model is installed: install query-gaussians-worlds, or name one (--model)"
        )
    return min(names, key=lambda name: (not name.startswith("worlds/"), name))


def photos_world(photos: ScenePhotos) -> tuple[Tensor, Tensor]:
    """Return the first camera's world, see `own_world`, in which photos show what is 1 away."""
    scale = 1 / scene_depth(photos.small)
    views = ViewsConfig(scale="constant", scale_factor=scale)
    return own_world(photos.small, photos.frames[:1], views)


def photos_start(
    scene: Scene, world: tuple[Tensor, Tensor], views: Views, count: int, most: int
) -> Gaussians:
    """Return Gaussians (1, G) at COLMAP's points where the scene has some, the others at pixels.

    count: of all at the end. most: at pixels, of the photos `views` (1, V), at least TIMED.
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
