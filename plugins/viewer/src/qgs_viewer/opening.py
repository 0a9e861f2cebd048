"""From what a user names to a source of scenes: a PLY, a finished reconstruction, a model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from qgs.checkpoint.gaussians import load_ply
from qgs.checkpoint.model_file import CheckpointFile
from qgs.contracts import Scene
from qgs.data.images import framing
from qgs.data.recognition import is_training_data
from qgs.domain import Domain, verdict
from qgs.recipe import Recipe, resolve
from qgs.reconstruction.reconstruct import choice, choose_sample
from qgs.reconstruction.scale import ScaleSearch, photo_settings
from qgs.reconstruction.scenes import chosen_scene, frame_list, named_scene
from qgs.wording import listed
from qgs_viewer.finished import is_finished, open_finished
from qgs_viewer.query_scene import QueryScene
from qgs_viewer.remarks import summary
from qgs_viewer.sources import ModelSource, Source


@dataclass(frozen=True)
class ViewOptions:
    """Options of `qgs view` for a model and its photos."""

    photos: str | None = None
    scene: str | None = None
    frames: str | None = None
    inputs: int | None = None
    size: tuple[int, int] | None = None
    overrides: Sequence[str] = ()
    device: str = "cpu"


def open_source(name: str, options: ViewOptions) -> Source:
    """Open a PLY, a reconstruction's folder, a run folder or a model.

    Raises ValueError for options that do not apply to it, and as the readers do.
    """
    path = Path(name).expanduser()
    finished = is_finished(path)
    if not finished and path.suffix.lower() != ".ply":
        return open_model(name, options)
    if given := [field for field, value in vars(replace(options, device="")).items() if value]:
        raise ValueError(
            f"{listed(given)}: only for a model, and {name} holds Gaussians; leave that out"
        )
    if finished:
        return open_finished(path, options.device)
    note = "A PLY file holds neither queries nor photos; name the model to see them."
    return Source(path.name, (note,), QueryScene(load_ply(path)))


def open_model(name: str, options: ViewOptions) -> Source:
    """Open a model with the photos of `options`, or else with the data of its recipe."""
    with CheckpointFile(name) as file:
        model = file.model(options.device)
        recipe = file.recipe
    if options.overrides:
        recipe = resolve(recipe.tree, options.overrides)
    scene = _scene(recipe, options)
    chosen = None if options.frames is None else frame_list(options.frames, "--frames", scene)
    trained = model.trained_on or Domain()
    own = options.photos is None or is_training_data(options.photos, recipe.data_config)
    # photos of a user have a unit of their own
    search = ScaleSearch(model, photo_settings(recipe.views, own, options.overrides))
    sample, _ = choose_sample(scene, recipe.views, options.inputs, chosen, None, trained, search)
    frames = sample.input_frames
    scales = list(search.found.values())
    # users learn if their photos are like those of the training
    seen = Domain()
    seen.see(sample.inputs.cameras, sample.targets.cameras)
    notes = [
        summary(scales) if scales else "",
        choice(sample, scene, compares=False) if options.photos else "",
        verdict(trained, seen, ["scale"] if scales else []),
        *(scale.poor for scale in scales),
        framing(scene, frames[0]),
    ]
    # inputs that are chosen later keep the scale
    views = search(scene, frames, sample.target_frames)
    title = f"{name}: {scene.name}"
    return ModelSource(model, scene, views, frames, title, [note for note in notes if note])


def _scene(recipe: Recipe, options: ViewOptions) -> Scene:
    """Return the scene of the photos, or the named or first test scene of the recipe's data."""
    if options.photos is not None:
        return chosen_scene(recipe, options.photos, options.size, options.scene).scene
    if recipe.data_config is None:
        raise ValueError("the checkpoint's recipe has no data: name a folder of photos after it")
    data = recipe.build_data()
    if options.size is not None:
        raise ValueError("--size is for photos: name a folder of them, or leave it out")
    if options.scene is not None:
        return named_scene(data, "the data of the recipe", options.scene)
    return data.scenes("test" if data.names("test") else "train")[0]
