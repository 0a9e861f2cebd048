"""Where the optimisation of `qgs scene` begins: a model's Gaussians, or some at the photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import torch
from rich.console import Console
from torch import Tensor

from qgs.checkpoint.model_file import load
from qgs.cli.options import scale_settings
from qgs.containers import concatenated
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.depth import scene_depth
from qgs.data.inputs import choose_windows
from qgs.data.photos.source import PhotoScene
from qgs.data.samples import own_world, views_in
from qgs.domain import Domain
from qgs.metrics.images import psnr
from qgs.model import QueryGaussianModel
from qgs.recipe import resolve
from qgs.recipe.registry import load_usable_plugins
from qgs.reconstruction.reconstruct import reconstruct
from qgs.reconstruction.scale import further_photos
from qgs.types import Gaussians, Views
from qgs.wording import listed
from qgs_photos.refine.options import NONE, Options
from qgs_photos.refine.points import from_points, sparse_points
from qgs_photos.refine.scene_photos import ScenePhotos
from qgs_photos.refine.sweeping import swept

ENOUGH = 4
"""Photos from which on a start at their pixels is as good as a model's, see docs/refine.md."""
TIMED = 2048
"""Pixels whose depth is found at least."""
# Part of the time in which models are compared.
_SEARCH = 0.15
# Photos on which they are.
_JUDGED = 4


@dataclass(frozen=True)
class Initialisation:
    """A model's Gaussians (1, G), or none for Gaussians at the photos, and their world.

    world: reference pose (4, 4) and scale, as of `own_world`. frames: names of the inputs. quality:
    PSNR in dB on photos near them.
    """

    model: str
    world: tuple[Tensor, Tensor]
    gaussians: Gaussians | None = None
    frames: Sequence[str] = ()
    quality: float = 0.0


def chosen_initialisation(
    photos: ScenePhotos, options: Options, seconds: float, console: Console
) -> Initialisation:
    """Take the photos alone where there are ENOUGH, unless a model or its options are wanted.

    Raises ValueError for options of a model that is not wanted, and as `best_model`.
    """
    of_model = options.frames is not None or options.scale is not None
    if options.model == NONE and of_model:
        raise ValueError("--frames and --scale are of a model: leave them out, or --model none")
    enough = not of_model and len(photos.frames) >= ENOUGH
    if options.model == NONE or (options.model is None and enough):
        return Initialisation(NONE, photos_world(photos))
    return best_model(photos, options, seconds, console)


def shipped_models() -> list[str]:
    """Return the models that installed plugins ship and whose files are there.

    Those of worlds, which were trained for photos, come first.
    """
    registry, _ = load_usable_plugins()
    models = [pair for plugin in registry.plugins.values() for pair in plugin.models.items()]
    names = (name for name, file in models if file.is_file())
    return sorted(names, key=lambda name: (not name.startswith("worlds/"), name))


def best_model(
    photos: ScenePhotos, options: Options, seconds: float, console: Console
) -> Initialisation:
    """Return what the model makes that renders photos near the inputs best.

    All take the inputs that the user named, or else those that the first one would choose. No
    further model is tried once _SEARCH of `seconds` is spent. Raises ValueError for no model.
    """
    models = [options.model] if options.model else shipped_models()
    if not models:
        raise ValueError(
            "no trained model is installed: install query-gaussians-worlds, or name one (--model)"
        )
    began = perf_counter()
    found = list[Initialisation]()
    inputs: str | Frames | None = options.frames
    for name in models:
        if found and perf_counter() - began > _SEARCH * seconds:
            break
        model = load(name, options.device)
        if inputs is None:
            views = resolve(model.recipe or {}).views
            windows = choose_windows(photos.small, views, model.trained_on or Domain())
            # all models get the same inputs, or scores would compare photos
            inputs, _ = windows[0]
        found.append(_predicted(photos, name, model, inputs, options.scale))
    if len(found) > 1:
        scores = listed(f"{each.model} {each.quality:.2f} dB" for each in found)
        console.print(f"photos near the inputs: {scores}", highlight=False, style="dim")
    return max(found, key=lambda each: each.quality)


def _predicted(
    photos: ScenePhotos,
    name: str,
    model: QueryGaussianModel,
    frames: str | Frames,
    scale: float | None,
) -> Initialisation:
    """Return what the model `name` makes of these inputs."""
    scene = photos.small
    result = reconstruct(
        model,
        photos.path,
        frames=frames,
        compare=photos.held_out,
        scene=photos.name,
        overrides=scale_settings(scale),
    )
    inputs = result.sample.input_frames
    judged = further_photos(scene, inputs, (), _JUDGED) or inputs
    views = views_in(result.world, scene, judged).to(result.gaussians.means.device)
    with torch.no_grad():
        rendered = model.render(result.gaussians, views.cameras).rgb
    return Initialisation(
        model=name,
        world=result.world,
        gaussians=result.gaussians,
        frames=[scene.frame_name(frame) for frame in inputs],
        quality=float(psnr(rendered, views.images).mean()),
    )


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
