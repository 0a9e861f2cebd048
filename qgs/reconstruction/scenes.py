"""Photos of a user as one scene: from a folder, its URL or Views."""

from collections.abc import Sequence
from os import PathLike, fspath
from typing import TypeAlias

import torch
from torch import Tensor

from qgs.contracts import Component, Encoder, Scene, SceneSource, SceneSourceConfig, Split
from qgs.data.recognition import open_for
from qgs.data.samples import views_in
from qgs.data.view_samplers import training_frames
from qgs.recipe import Recipe
from qgs.recipe.registry import load_usable_plugins
from qgs.types import Cameras, Views
from qgs.wording import listed, warn_once

HOLDOUT = 8
"""Every n-th photo of a user's scene is held out, as papers on novel views do (Mip-NeRF 360)."""
FrameNames: TypeAlias = str | Sequence[int | str]
Size: TypeAlias = tuple[int, int]


def read_photos(
    folder: str | PathLike[str],
    *,
    size: Size | None = None,
    frames: FrameNames | None = None,
    scene: str | None = None,
) -> Views:
    """Photos and cameras of a folder, or its URL, as Views (1, V) in the photos' own world.

    size: (H, W) to crop and resize to; of the first photo by default. frames: numbers or file
    names; all by default. scene: name, where the folder holds several. Raises FileNotFoundError,
    ValueError, and TooLargeError for more photos than fit into memory.
    """
    found = photo_scene(fspath(folder), size, scene)
    wanted = range(len(found)) if frames is None else frame_list(frames, "frames", found)
    origin = torch.eye(4, dtype=torch.float64)
    unit = torch.ones((), dtype=torch.float64)
    return views_in((origin, unit), found, tuple(wanted))


def photo_scene(path: str, size: Size | None, name: str | None) -> Scene:
    """Return the scene called `name` at `path`, or the only one.

    size: (H, W) of images; by default the stored size of the first photo.
    """
    source, _ = open_for(path, size, None, installed_sources())
    scene = named_scene(source, path, name)
    # The stored size is known once the scene is open.
    if size is None and (stored := scene.stored_size(0)):
        scene = named_scene(_resized(source, source.config, stored), path, name)
    return scene


def chosen_scene(
    recipe: Recipe, path: str, size: Size | None, name: str | None, holdout: bool = True
) -> tuple[Scene, Sequence[int] | None]:
    """Return the scene called `name` at `path`, or the only one, for a model of `recipe`.

    And the frames that the model was trained on; None for other photos than the training's.
    size: (H, W) of its images; by default the recipe's, or for other photos `whole_size`. holdout:
    hold out every HOLDOUT-th photo that nobody else splits. Raises ValueError without a size.
    """
    if recipe.data_config is None and size is None:
        raise ValueError(
            "the checkpoint's recipe has no data, so its image size is not known: give `size`, "
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
    return named_scene(_resized(source, config, whole), path, name), None


def _resized(source: SceneSource, config: SceneSourceConfig, size: Size) -> SceneSource:
    """Return `source` opened again, with the options `config` and images of this size."""
    return type(source)(config.model_copy(update={"image_size": size}))


def holding_out(config: SceneSourceConfig, scene: Scene) -> SceneSourceConfig:
    """Return options with every HOLDOUT-th photo held out, unless `scene` or they have a split."""
    # A listing's own split, or one in the options, is somebody's decision.
    split = scene.held_out or getattr(config, "holdout", None) != 0
    return config if split else config.model_copy(update={"holdout": HOLDOUT})


def whole_size(scene: Scene, multiple: int | None) -> Size:
    """Return (H, W) at which a model sees the photos of `scene`, opened at the trained size, whole.

    The shorter side is the trained one, the aspect that of the first photo, both sides multiples
    of `multiple`; the trained size without one, and where images are made to measure.
    """
    trained = scene.cameras.size
    stored = scene.stored_size(0)
    if multiple is None or stored is None:
        return trained
    # As many pixels as in training gave up to .3 dB less on novel views than its shorter side.
    steps = min(trained) / min(stored) / multiple
    height, width = (max(round(side * steps), 1) * multiple for side in stored)
    return height, width


def size_multiple(recipe: Recipe) -> int | None:
    """Return the divisor of both sides of the model's images; None if their size is fixed."""
    # The part is known without building a model.
    part = recipe.parts["model", "encoder"]
    assert issubclass(part.component, Encoder)
    return part.component.size_multiple(part.config)


def installed_sources() -> dict[str, type[Component]]:
    """Return all installed sources by PLUGIN/NAME; warn of plugins that cannot be loaded."""
    registry, broken = load_usable_plugins()
    for problem in broken:
        warn_once(f"left out: {problem}")
    return registry.components("data")


def named_scene(source: SceneSource, path: str, name: str | None) -> Scene:
    """Return the scene called `name` of `source`, opened at `path`, or the only one.

    Raises ValueError where there is none of that name, or several without a name.
    """
    splits: tuple[Split, ...] = ("train", "test")
    places: dict[str, tuple[Split, int]] = {}
    for split in splits:
        places |= {known: (split, place) for place, known in enumerate(source.names(split))}
    if name is None and len(places) == 1:
        (name,) = places
    if name not in places:
        found = f"no scene {name!r}, but" if name is not None else f"{len(places)} scenes:"
        raise ValueError(f"{path} holds {found} {listed(places)}: name one of them (scene)")
    split, place = places[name]
    return source.scenes(split)[place]


def frame_list(frames: FrameNames, option: str, scene: Scene) -> list[int]:
    """Return frame numbers of "0,8,x.jpg" or [0, 8, "x.jpg"]; folders of a photo may be left out.

    Raises ValueError for what is neither a number nor the name of one photo of `scene`.
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
            fits = f"fits {listed(map(scene.label, found))}" if found else "is no photo"
            raise ValueError(
                f"{option}: {part!r} {fits}. Give numbers or file names of photos with commas "
                f"between, such as 0,8,16, of {scene.label(0)} to {scene.label(len(names) - 1)}"
            )
        numbers += found
    return numbers


class GivenScene(Scene):
    """Views (1, V) as a scene. ValueError for several scenes, wrong images and a target time."""

    name = "views"

    def __init__(self, views: Views) -> None:
        if views.images.shape[0] != 1:
            raise ValueError(
                f"one scene is reconstructed at a time, got {views.images.shape[0]}; of several "
                "take one, such as map_tensors(lambda x: x[:1], views)"
            )
        # Resampling overshoots [0, 1] a little at edges.
        low, high = map(float, views.images.aminmax())
        if low < -0.5 or high > 1.5:
            raise ValueError(
                f"images have values from {low:.3g} to {high:.3g} and must lie in [0, 1]: divide "
                "8-bit values by 255, undo a subtracted mean"
            )
        if views.target_time is not None:
            raise ValueError(
                "a target_time is the time of compared photos: name those by `compare`"
            )
        self.views = views = views.to("cpu")
        self.times = None if views.times is None else views.times[0].double()

    @property
    def cameras(self) -> Cameras:
        """See `Scene`."""
        cameras = self.views.cameras[0]
        return Cameras(cameras.c2w.double(), cameras.intrinsics, cameras.size)

    def images(self, frames: Sequence[int]) -> Tensor:
        """See `Scene`."""
        return self.views.images[0, list(frames)].float()

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """See `Scene`."""
        return None if self.views.masks is None else self.views.masks[0, list(frames)].float()
