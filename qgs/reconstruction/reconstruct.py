"""Reconstruction of a scene in one call: choose photos, search for the scale, run the model."""

from collections.abc import Sequence
from dataclasses import replace
from os import fspath

from torch import Tensor

from qgs.contracts import Frames, Scene, ViewsConfig, Window
from qgs.data.inputs import NOVEL, Frusta, ranked_windows
from qgs.data.samples import Sample, make_sample
from qgs.data.view_samplers import evenly, moments, spread
from qgs.domain import Domain, verdict
from qgs.evaluate.tuning import tune as tuned_on
from qgs.evaluate.tuning import tuning_settings
from qgs.files import AnyPath
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs.reconstruction.result import Reconstruction, reconstruct_sample
from qgs.reconstruction.scale import (
    constant_scale,
    find_scale,
    find_size,
    half,
    photo_settings,
)
from qgs.reconstruction.scenes import FrameNames, GivenScene, chosen_scene, frame_list
from qgs.types import Size, Views
from qgs.wording import counted, listed


def reconstruct(
    model: QueryGaussianModel,
    photos: AnyPath | Views,
    *,
    inputs: int | None = None,
    frames: FrameNames | None = None,
    compare: FrameNames | None = None,
    size: Size | None = None,
    scene: str | None = None,
    overrides: Sequence[str] = (),
    tune: str | None = None,
) -> Reconstruction:
    """Reconstruct one scene from photos, as the command `qgs reconstruct` does.

    Cameras are moved to the frame of the model's recipe. For photos that are no training data,
    `find_scale` replaces a constant scale, and `find_size` may halve the size from `whole_size`.
    photos: a folder of photos, its URL, or Views (1, V) with OpenCV cameras, which are all inputs
        unless `inputs` or `frames` is given. inputs: number of input photos; None: see
        `choose_frames`. frames: input photos, by number or file name; None chooses photos.
    compare: photos to score; "none": no photos; None: held-out photos (every eighth) near inputs.
    size: (H, W) to crop and resize photos to. scene: name of a scene in the folder.
    overrides: changes of the recipe's `views`. tune: what to fit first, such as "queries:50".
    Raises ValueError without a recipe, for several scenes, and for images outside of [0, 1].
    """
    recipe = _recipe(model, overrides, tune)
    seen: Sequence[int] | None = None
    if isinstance(photos, Views):
        if size is not None or scene is not None:
            raise ValueError("`size` and `scene` work only for folders, not for Views: remove them")
        found: Scene = GivenScene(photos)
        if frames is None and inputs is None:
            frames = range(len(found))
    else:
        found, seen = chosen_scene(recipe, fspath(photos), size, scene, compare is None)
    wanted = None if frames is None else frame_list(frames, "frames", found)
    against = [] if compare == "none" else compare
    against = None if against is None else frame_list(against, "compare", found)
    window = choose_frames(found, recipe.views, inputs, wanted, against, model.trained_on)
    # Training data keep the recipe's scale; photos of a user may have any unit.
    views = photo_settings(recipe.views, seen is not None, overrides)
    free = seen is None and size is None and not isinstance(photos, Views)
    training = model.training
    tuning = None
    try:
        model.eval()
        scale = find_scale(model, found, *window, views) if views.scale == "search" else None
        if scale:
            views = constant_scale(views, scale.factor)
        sample = make_sample(found, *window, views)
        chosen = find_size(model, found, *window, views) if free else None
        if chosen and chosen.halved:
            sample = half(sample, model) or sample
        tuned = chosen.gaussians if chosen else None
        if tune and recipe.evaluation.tuning_steps:
            tuned, tuning = tuned_on(model, sample.inputs, recipe)
        result = reconstruct_sample(model, sample, seen or (), tuned)
    finally:
        model.train(training)
    result = replace(result, scale=scale, size=chosen, tuning=tuning)
    return replace(result, remarks=_remarks(result, found))


def _recipe(model: QueryGaussianModel, overrides: Sequence[str], tune: str | None) -> Recipe:
    """Return the model's recipe, changed by `overrides` of `views` and by the preset `tune`."""
    if model.recipe is None:
        raise ValueError(
            "this model was built by hand and has no recipe, so the frame and scale of its world "
            "are not known; build it with qgs.compose, or call it on cameras in its own world"
        )
    # The weights fit only the model options of the recipe.
    if foreign := [text for text in overrides if not text.startswith("views.")]:
        raise ValueError(f"overrides can only change options of `views`, got {listed(foreign)}")
    return resolve(model.recipe, [*overrides, *tuning_settings(tune)])


def choose_frames(
    scene: Scene,
    views: ViewsConfig,
    inputs: int | None,
    frames: Sequence[int] | None,
    compare: Sequence[int] | None,
    trained_on: Domain,
) -> Window:
    """Return the input frames of `scene` and the frames to compare the result with.

    inputs: number of inputs; None uses `views.inputs`, and a third one between two if possible.
    frames: input frames that the user chose; None spreads them over time if the scene has times,
        and otherwise takes them from the best window of `ranked_windows`.
    compare: the user's choice of frames to compare with. None chooses frames that the inputs see;
        if the scene has times, frames of a single time between the inputs.
    trained_on: distances and angles of cameras in the model's training; empty allows any.
    Raises ValueError for frames that do not exist or repeat, and for too few frames.
    """
    views = views.model_copy(update={"inputs": inputs or views.inputs})
    novel: Frames = ()
    if frames is not None:
        checked_window(len(scene), frames)
    if scene.times is not None:
        frames, novel = _over_time(scene, scene.times, views, frames)
    elif frames is None:
        frusta = Frusta(scene, trained_on)
        frames = tuple(range(len(scene)))
        target = None
        if ranked := ranked_windows(frusta, views.inputs, compare):
            _, frames, target = ranked[0]
            scored = (target, *scene.held_out) if compare is None else compare
            # Novel views between two inputs gain 1 to 3 dB from a third one there.
            if not inputs:
                frames = frusta.with_middle(frames, scored)
        novel = frusta.compared(frames, target)
    elif compare is None:
        novel = Frusta(scene, trained_on).compared(tuple(frames))
    # Photos that the user names replace the chosen ones.
    return checked_window(len(scene), frames, novel if compare is None else compare)


def checked_window(total: int, frames: Sequence[int], compare: Sequence[int] = ()) -> Window:
    """Return input and compared frames; raise ValueError if a frame repeats or does not exist.

    frames: the inputs. total: number of frames of the scene.
    """
    every = [*frames, *compare]
    if missing := [frame for frame in every if not 0 <= frame < total]:
        raise ValueError(f"frames {listed(missing)} do not exist; choose from 0..{total - 1}")
    if twice := sorted({frame for frame in every if every.count(frame) > 1}):
        raise ValueError(
            f"these frames are named twice: {listed(twice)}; inputs and compared frames must differ"
        )
    return tuple(frames), tuple(compare)


def _over_time(
    scene: Scene, times: Tensor, views: ViewsConfig, frames: Sequence[int] | None
) -> Window:
    """Return inputs spread over time, and at most NOVEL frames between them to compare with.

    Compared frames all have one time. They are held-out frames if any lie between the inputs,
    otherwise any frames. frames: inputs that the user chose; None chooses `views.inputs` frames.
    """
    if frames is None:
        usable = moments(scene)
        if views.inputs > len(usable):
            raise ValueError(
                f"photos were taken at {len(usable)} different times, too few for {views.inputs} "
                "inputs: choose fewer inputs"
            )
        first = max(len(usable) - max(views.gap[1] + 1, views.inputs), 0) // 2
        frames = spread(usable[first : len(usable) - first], views.inputs)
    between = [f for f in range(min(frames), max(frames) + 1) if f not in frames]
    held_out = [frame for frame in between if frame in scene.held_out]
    novel = evenly(held_out or between, NOVEL)
    # A model renders one time in one pass.
    moment = times[novel[len(novel) // 2]] if novel else None
    return tuple(frames), tuple(frame for frame in novel if times[frame] == moment)


def _remarks(result: Reconstruction, scene: Scene) -> list[str]:
    """Return remarks for the user on the photos and on the result's quality."""
    sample = result.sample
    found = Domain()
    found.see(sample.inputs.cameras, sample.targets.cameras)
    # A size that was found better needs no warning.
    if result.size:
        del found.values["side"]
    remarks = (
        result.scale.poor if result.scale else "",
        result.worse_than_nearest,
        verdict(result.model.trained_on, found),
        choice(sample, scene),
    )
    return [*filter(None, remarks)]


def choice(sample: Sample, scene: Scene) -> str:
    """Return text that names inputs and compared photos, and counts the held-out photos."""
    text = f"inputs {listed(map(scene.frame_name, sample.input_frames))}"
    if sample.target_frames:
        text += f", compared with {listed(map(scene.frame_name, sample.target_frames))}"
    if scene.held_out:
        text += f"; {len(scene.held_out)} of {counted(len(scene), 'photo')} held out"
    return text
