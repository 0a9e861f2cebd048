"""A scene made of a user's photos: from a folder, from a URL, or from Views."""

from collections.abc import Sequence
from os import fspath
from typing import get_args

import torch
from torch import Tensor

from qgs.contracts import Component, Encoder, Scene, SceneSource, SceneSourceConfig, Split
from qgs.data.recognition import open_for
from qgs.data.samples import views_in
from qgs.data.scenes import resized
from qgs.data.view_samplers import training_frames
from qgs.files import AnyPath
from qgs.recipe import Recipe
from qgs.recipe.registry import load_usable_plugins
from qgs.types import Cameras, Size, Views
from qgs.wording import listed, warn_once

LEAST = 128
"""Shorter side in pixels: models trained on at least so many read photos of up to LARGEST pixels,
and photos of no more are never halved."""
LARGEST = 256
"""Shorter side of photos in pixels, at most, that no --size asks for."""
HOLDOUT = 8
"""Every HOLDOUT-th photo of a user's scene is held out to score the result (Mip-NeRF 360)."""
FrameNames = str | Sequence[int | str]


def read_photos(
    folder: AnyPath,
    *,
    size: Size | None = None,
    frames: FrameNames | None = None,
    scene: str | None = None,
) -> Views:
    """Read the photos and cameras of a folder or URL as Views (1, V), in the photos' own world.

    size: (H, W) to which photos are cropped and resized; None uses the size of the first photo.
    frames: numbers or file names of photos; None reads all photos.
    scene: name of the scene, for a folder of several scenes.
    Raises FileNotFoundError, ValueError, and TooLargeError for more photos than fit into memory.
    """
    found = photo_scene(fspath(folder), size, scene)
    wanted = range(len(found)) if frames is None else frame_list(frames, "frames", found)
    own = (torch.eye(4).double(), torch.ones(()).double())
    return views_in(own, found, tuple(wanted))


def photo_scene(path: str, size: Size | None, name: str | None) -> Scene:
    """Return the scene called `name` at `path`; None stands for the only scene.

    size: (H, W) of images; None uses the stored size of the first photo.
    """
    source, _ = open_for(path, size, None, installed_sources())
    scene = named_scene(source, path, name)
    # The stored size is known once the scene is open.
    if size is None and (stored := scene.stored_size(0)):
        scene = named_scene(resized(source, source.config, stored), path, name)
    return scene


def chosen_scene(
    recipe: Recipe, path: str, size: Size | None, name: str | None, holdout: bool = True
) -> tuple[Scene, Sequence[int] | None]:
    """Open a scene for a model of `recipe`; return it and the frames that the model was trained on.

    The frames are None if `path` is not part of the model's training data.
    name: name of the scene; None stands for the only scene.
    size: (H, W) of images. None uses the recipe's size for training data, and the result of
        `whole_size` for other photos.
    holdout: whether to hold out every HOLDOUT-th photo. Training data, and scenes that already hold
        out photos, are not changed.
    Raises ValueError if `size` is None and the recipe has no data.
    """
    if recipe.data_config is None and size is None:
        raise ValueError(
            "the recipe of the model has no data, so the image size is not known: give `size`, "
            "such as 256x256"
        )
    source, is_training_data = open_for(path, size, recipe.data_config, installed_sources())
    scene = named_scene(source, path, name)
    if is_training_data:
        # Scenes of the test split were never seen, though their folder was trained on.
        seen = training_frames(scene) if scene.name in source.names("train") else ()
        return scene, seen
    # Size and split depend on the photos, so the scene is opened once more.
    whole = size or whole_size(scene, size_multiple(recipe))
    config = holding_out(source.config, scene) if holdout else source.config
    return named_scene(resized(source, config, whole), path, name), None


def holding_out(config: SceneSourceConfig, scene: Scene) -> SceneSourceConfig:
    """Return `config` with every HOLDOUT-th photo held out.

    `config` is returned unchanged if `config` or `scene` already holds out photos, or if `config`
    has no option `holdout`.
    """
    # A listing's own split, or one in the options, is somebody's decision.
    split = scene.held_out or getattr(config, "holdout", None) != 0
    return config if split else config.model_copy(update={"holdout": HOLDOUT})


def whole_size(scene: Scene, multiple: int | None) -> Size:
    """Return the image size (H, W) at which photos of a user are resized without cropping.

    The shorter side is about that of the training images. For models of LEAST pixels and more it is
    LARGEST if the first photo is that large; `find_size` then decides between this size and its
    half. The aspect ratio is about that of the first photo.
    multiple: number that must divide both sides of an image.
    scene: must be opened at the size of the training images. This size is returned if `multiple` is
        None, or if `scene` generates its images.
    """
    trained = scene.cameras.size
    stored = scene.stored_size(0)
    if multiple is None or stored is None:
        return trained
    # As many pixels as in training gave up to .3 dB less on novel views than its shorter side.
    shorter = min(trained)
    if shorter >= LEAST and min(stored) >= LARGEST:
        shorter = max(shorter, LARGEST)
        # Half the size must fit too.
        multiple *= 2
    steps = shorter / min(stored) / multiple
    height, width = (max(round(side * steps), 1) * multiple for side in stored)
    return height, width


def size_multiple(recipe: Recipe) -> int | None:
    """Return the number that must divide both image sides; None if the image size is fixed."""
    # The part is known without building a model.
    part = recipe.parts["model", "encoder"]
    assert issubclass(part.component, Encoder)
    return part.component.size_multiple(part.config)


def installed_sources() -> dict[str, type[Component]]:
    """Return all installed data sources by PLUGIN/NAME; warn of plugins that cannot be loaded."""
    registry, broken = load_usable_plugins()
    for problem in broken:
        warn_once(f"a plug-in is left out: {problem}")
    return registry.components("data")


def named_scene(source: SceneSource, path: str, name: str | None) -> Scene:
    """Return the scene called `name` of `source`; None stands for its only scene.

    Raises ValueError if no scene has this name, or if `name` is None and there are several scenes.
    path: location of the source, for messages.
    """
    places: dict[str, tuple[Split, int]] = {}
    for split in get_args(Split):
        places |= {known: (split, place) for place, known in enumerate(source.names(split))}
    if name is None and len(places) == 1:
        (name,) = places
    if name not in places:
        found = f"no scene {name!r}, but" if name is not None else f"{len(places)} scenes:"
        raise ValueError(f"{path} holds {found} {listed(places)}: name one of them as `scene`")
    split, place = places[name]
    return source.scenes(split)[place]


def frame_list(frames: FrameNames, option: str, scene: Scene) -> list[int]:
    """Convert photos named by the user, "0,8,x.jpg" or [0, 8, "x.jpg"], to frame numbers.

    File names may lack leading folders. Raises ValueError for text that is neither a number nor the
    name of exactly one photo of `scene`. option: name of the user's option, for the message.
    """
    names = [scene.frame_name(frame) for frame in range(len(scene))]
    numbers: list[int] = []
    for part in frames.split(",") if isinstance(frames, str) else map(str, frames):
        part = part.strip()
        if part.removeprefix("-").isdecimal():
            numbers.append(int(part))
            continue
        # From a folder's start on: "1.png" is not "11.png".
        found = [frame for frame, name in enumerate(names) if f"/{name}".endswith(f"/{part}")]
        if len(found) != 1:
            fits = f"matches {listed(map(scene.label, found))}" if found else "is no photo"
            raise ValueError(
                f"{option}: {part!r} {fits}. Give numbers or file names of photos, separated by "
                f"commas, such as 0,8,16, from {scene.label(0)} to {scene.label(len(names) - 1)}"
            )
        numbers += found
    return numbers


class GivenScene(Scene):
    """Views (1, V) that a user gave, as a scene.

    Raises ValueError for several scenes, for pixels far outside of [0, 1], and for views with a
    target time.
    """

    name = "views"

    def __init__(self, views: Views) -> None:
        if len(views.images) != 1:
            raise ValueError(
                f"one scene is reconstructed at a time, got {len(views.images)}; select one, "
                "such as the first: map_tensors(lambda x: x[:1], views)"
            )
        # Resampling overshoots [0, 1] a little at edges.
        low, high = map(float, views.images.aminmax())
        if low < -0.5 or high > 1.5:
            raise ValueError(
                f"images have values from {low:.3g} to {high:.3g}, but must lie in [0, 1]: divide "
                "8-bit values by 255, and undo a normalisation"
            )
        if views.target_time is not None:
            raise ValueError(
                "these Views have a target_time, but renderings are compared with photos, at the "
                "times of the photos: remove target_time, and give photos of that time as `compare`"
            )
        self.views = views = views.to("cpu")
        self.times = None if views.times is None else views.times[0].double()

    @property
    def cameras(self) -> Cameras:
        """Cameras of all frames, in float64."""
        return self.views.cameras[0].to(torch.float64)

    def images(self, frames: Sequence[int]) -> Tensor:
        """Return images (len(frames), 3, H, W)."""
        return self.views.images[0, list(frames)].float()

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """Return masks (len(frames), 1, H, W), 1 on the object; None without masks."""
        return None if self.views.masks is None else self.views.masks[0, list(frames)].float()
