"""Photos of a user as one scene, and its reconstruction in one call."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike, fspath
from typing import TypeAlias

import torch
from torch import Tensor

from qgs.contracts import Component, Encoder, Scene, SceneSource, SceneSourceConfig, Split
from qgs.data.images import framing
from qgs.data.recognition import is_training_data, open_for
from qgs.data.samples import Sample, training_frames, views_in
from qgs.domain import Domain, value_range_problem, verdict
from qgs.evaluate.tuning import tuned_gaussians, tuning_settings
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs.recipe.registry import load_usable_plugins
from qgs.reconstruction.result import Reconstruction, choose_sample, reconstruct_sample
from qgs.reconstruction.scale import ScaleSearch, photo_settings
from qgs.types import Cameras, Views
from qgs.wording import counted, listed, warn_once

HOLDOUT = 8
"""Every n-th photo of a user's scene is held out, as papers on novel views do (Mip-NeRF 360)."""
Frames: TypeAlias = str | Sequence[int | str]
Size: TypeAlias = tuple[int, int]


def read_photos(
    folder: str | PathLike[str],
    *,
    size: Size | None = None,
    frames: Frames | None = None,
    scene: str | None = None,
) -> Views:
    """Photos and cameras of a folder, or its URL, as Views (1, V) in the photos' own world.

    size: (H, W) to crop and resize to; of the first photo by default. frames: numbers or file
    names; all by default. scene: name, where the folder holds several. Raises FileNotFoundError,
    ValueError, and TooLargeError for more photos than fit into memory.
    """
    sources, path = installed_sources(), fspath(folder)
    found = named_scene(open_for(path, size, None, sources)[0], path, scene)
    if size is None and (stored := found.stored_size(0)):
        found = named_scene(open_for(path, stored, None, sources)[0], path, scene)
    wanted = range(len(found)) if frames is None else frame_list(frames, "frames", found)
    here = torch.eye(4, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    return views_in(here, found, tuple(wanted))


def reconstruct(
    model: QueryGaussianModel,
    photos: str | PathLike[str] | Views,
    *,
    inputs: int | None = None,
    frames: Frames | None = None,
    compare: Frames | None = None,
    size: Size | None = None,
    scene: str | None = None,
    overrides: Sequence[str] = (),
    tune: str | None = None,
) -> Reconstruction:
    """Reconstruct one scene as `qgs reconstruct` does, in the frame of the recipe.

    The scale is the recipe's; where that is a constant and the model was not trained on these
    photos, it is searched, see `qgs.reconstruction.scale`.

    photos: a folder of photos and cameras, or its URL; or Views (1, V) in any world, which all
        become inputs unless `frames` names some. OpenCV cameras, images in [0, 1].
    inputs: how many; the recipe's number by default.
    frames: which photos, by number or file name; by default see `qgs.data.inputs`.
    compare: photos to compare with, "none" or no frames for none; of a folder, by default those
        near the inputs of every eighth photo, which is held out.
    size: (H, W) of the photos of a folder; by default see `chosen_scene`.
    scene: name, where a folder holds several.
    overrides: of the recipe's `views`, such as "views.scale=auto".
    tune: fit queries or latents to the inputs first, see `qgs.evaluate.tuning.tuning_settings`.

    Raises ValueError for a model without a recipe, several scenes, and images out of range, and as
    the data do.
    """
    if model.recipe is None:
        raise ValueError(
            "this model was built by hand and has no recipe, so the frame and scale of its world "
            "are not known; build it with qgs.compose, or bring cameras into its world yourself"
        )
    if foreign := [text for text in overrides if not text.startswith("views.")]:
        raise ValueError(f"only options of `views` can be set here, got {listed(foreign)}")
    recipe = resolve(model.recipe, [*overrides, *tuning_settings(tune)])
    if isinstance(photos, Views):
        if size is not None or scene is not None:
            raise ValueError("`size` and `scene` are for folders: Views have one scene and size")
        found, seen, own = GivenScene(photos), (), False
        frames = range(len(found)) if frames is None and inputs is None else frames
    else:
        found, seen = chosen_scene(recipe, fspath(photos), size, scene, compare is None)
        own = is_training_data(fspath(photos), recipe.data_config)
    wanted = None if frames is None else frame_list(frames, "frames", found)
    against = [] if compare == "none" else compare
    against = None if against is None else frame_list(against, "compare", found)
    search = ScaleSearch(model, photo_settings(recipe.views, own, overrides))
    domain = model.trained_on
    sample, world = choose_sample(found, recipe.views, inputs, wanted, against, domain, search)
    training = model.training
    try:
        model.eval()
        steps = recipe.evaluation.tuning_steps if tune else 0
        tuned, record = tuned_gaussians(model, recipe, sample.inputs) if steps else (None, None)
        result = reconstruct_sample(model, sample, world, seen, tuned, record)
    finally:
        model.train(training)
    result = replace(result, scale=next(iter(search.found.values()), None))
    return replace(result, remarks=_remarks(result, found))


def _remarks(result: Reconstruction, scene: Scene) -> list[str]:
    """What a user must know of photos and result."""
    sample, found = result.sample, Domain()
    found.see(sample.inputs.cameras, sample.targets.cameras)
    fixed = ["scale"] if result.scale else []
    likeness = verdict(result.model.trained_on or Domain(), found, fixed)
    poor = result.scale.poor if result.scale else ""
    kept = framing(scene, sample.input_frames[0])
    remarks = choice(sample, scene), likeness, poor, kept, result.worse_than_nearest
    return [*filter(None, remarks)]


def choice(sample: Sample, scene: Scene, compares: bool = True) -> str:
    """A sentence on the photos of `sample` and, if it compares, on those that `scene` holds out."""
    names = [[scene.frame_name(f) for f in s] for s in (sample.input_frames, sample.target_frames)]
    text = f"inputs {listed(names[0])}"
    if not compares:
        return text
    text += f", compared with {listed(names[1])}" if names[1] else ""
    held = f"{len(scene.held_out)} of {counted(len(scene), 'photo')} held out"
    return f"{text}; {held}" if scene.held_out else text


class GivenScene(Scene):
    """Views (1, V) as a scene. ValueError for several scenes, wrong images and a target time."""

    name = "views"

    def __init__(self, views: Views) -> None:
        if views.images.shape[0] != 1:
            raise ValueError(
                f"one scene is reconstructed at a time, got {views.images.shape[0]}; of several "
                "take one, such as map_tensors(lambda x: x[:1], views)"
            )
        if fault := value_range_problem(views.images):
            raise ValueError(fault)
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


def installed_sources() -> dict[str, type[Component]]:
    """All installed sources of data, by PLUGIN/NAME; warns of plugins that cannot be loaded."""
    registry, broken = load_usable_plugins()
    for problem in broken:
        warn_once(f"left out: {problem}")
    return registry.components("data")


def chosen_scene(
    recipe: Recipe, path: str, size: Size | None, name: str | None, holdout: bool = True
) -> tuple[Scene, Sequence[int]]:
    """The scene called `name` at `path`, or the only one, and the frames a model was trained on.

    size: (H, W) of its images; by default the recipe's, or for other photos than the training's
    `whole_size`. holdout: hold out every HOLDOUT-th photo that nobody else splits. Raises
    ValueError without a size.
    """
    if recipe.data_config is None and size is None:
        raise ValueError(
            "the checkpoint's recipe has no data, so its image size is not known: give `size`, "
            "such as 256x256"
        )
    source, is_training_data = open_for(path, size, recipe.data_config, installed_sources())
    scene = named_scene(source, path, name)
    if size is None and not is_training_data:
        whole = whole_size(scene, size_multiple([recipe]))
        if whole != scene.cameras.size:
            return chosen_scene(recipe, path, whole, name, holdout)
    options = holding_out(source.config, scene)
    if holdout and not is_training_data and options is not source.config:
        scene = named_scene(type(source)(options), path, name)
    seen = is_training_data and scene.name in source.names("train")
    return scene, training_frames(scene) if seen else ()


def holding_out(config: SceneSourceConfig, scene: Scene) -> SceneSourceConfig:
    """Options with every HOLDOUT-th photo held out, unless `scene` or they have a split."""
    split = scene.held_out or getattr(config, "holdout", None) != 0
    return config if split else config.model_copy(update={"holdout": HOLDOUT})


def whole_size(scene: Scene, multiple: int | None) -> Size:
    """(H, W) at which a model sees the photos of `scene`, opened at the trained size, whole.

    The shorter side is the trained one, the aspect that of the first photo, both sides multiples
    of `multiple`; the trained size without one, and where images are made to measure.
    """
    trained, stored = scene.cameras.size, scene.stored_size(0)
    if multiple is None or stored is None:
        return trained
    # as many pixels as in training gave up to .3 dB less on novel views than its shorter side
    steps = min(trained) / min(stored) / multiple
    height, width = (max(round(side * steps), 1) * multiple for side in stored)
    return height, width


def size_multiple(recipes: Iterable[Recipe]) -> int | None:
    """Of which both sides of an image must be multiples for all models; None where one is fixed."""
    known = list[int]()
    for part in (recipe.parts["model", "encoder"] for recipe in recipes):
        assert issubclass(part.component, Encoder)
        multiple = part.component.size_multiple(part.config)
        if multiple is None:
            return None
        known.append(multiple)
    return math.lcm(*known)


def named_scene(source: SceneSource, path: str, name: str | None) -> Scene:
    """The scene called `name` of `source`, opened at `path`, or the only one; else ValueError."""
    splits: tuple[Split, ...] = ("train", "test")
    places: dict[str, tuple[Split, int]] = {
        known: (split, place) for split in splits for place, known in enumerate(source.names(split))
    }
    if name is None and len(places) == 1:
        (name,) = places
    if name not in places:
        found = f"no scene {name!r}, but" if name is not None else f"{len(places)} scenes:"
        raise ValueError(f"{path} holds {found} {listed(places)}: name one of them (scene)")
    split, place = places[name]
    return source.scenes(split)[place]


def frame_list(frames: Frames, option: str, scene: Scene) -> list[int]:
    """Frame numbers of "0,8,x.jpg" or [0, 8, "x.jpg"]; folders of a photo may be left out.

    Raises ValueError for what is neither a number nor the name of one photo of `scene`.
    """
    names = [scene.frame_name(frame) for frame in range(len(scene))]
    numbers: list[int] = []
    for part in frames.split(",") if isinstance(frames, str) else map(str, frames):
        part = part.strip()
        found = [f for f, name in enumerate(names) if f"/{name}".endswith(f"/{part}")]
        found = [int(part)] if part.removeprefix("-").isdecimal() else found
        if len(found) != 1:
            fits = f"fits {listed(map(scene.label, found))}" if found else "is no photo"
            raise ValueError(
                f"{option}: {part!r} {fits}. Give numbers or file names of photos with commas "
                f"between, such as 0,8,16, of {scene.label(0)} to {scene.label(len(names) - 1)}"
            )
        numbers += found
    return numbers
