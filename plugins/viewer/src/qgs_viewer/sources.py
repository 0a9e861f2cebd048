"""From what a user names to something that gives looks: a PLY, a reconstruction, a model."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from qgs.analysis.reconstruction import choose_frames, choose_sample
from qgs.analysis.scenes import chosen_scene, frame_list, named_scene
from qgs.composer import Recipe, resolve
from qgs.contracts import Scene, ViewsConfig
from qgs.data.domain import Domain, verdict
from qgs.data.images import framing
from qgs.data.sampling import make_sample, own_world, views_in
from qgs.geometry.poses import relative_to, scaled
from qgs.io.checkpoint import CheckpointFile
from qgs.io.gaussians import load_ply
from qgs.model import QueryGaussianModel
from qgs.types import Cameras
from qgs.wording import listed
from qgs_viewer.files import CAMERAS, PLY, REFINED, Finished, read_finished
from qgs_viewer.look import Look, look_inside
from qgs_viewer.placement import Placement

SAME = 0.02
"""Median distance of means, per spread of the scene, up to which a model made a PLY's Gaussians.

A finished reconstruction keeps its photos in 8 bits, which moves means by some thousandths."""


class Source(ABC):
    """What is looked at. title: its name. notes: what is to be said of it. frames: of the inputs
    at first. labels: of all frames; none where the inputs cannot be changed."""

    title: str
    notes: Sequence[str] = ()
    frames: Sequence[int] = ()
    labels: Sequence[str] = ()

    @abstractmethod
    def look(self, frames: Sequence[int]) -> Look:
        """The scene as made of these frames. Raises ValueError for frames that do not fit."""

    def cameras(self) -> Cameras | None:
        """Cameras (F,) of all frames in the shown world; None without."""
        return None


class FixedSource(Source):
    """Gaussians that no model is known of, whose inputs cannot be changed."""

    def __init__(self, fixed: Look, title: str, notes: Sequence[str]) -> None:
        self.fixed, self.title, self.notes = fixed, title, notes

    def look(self, frames: Sequence[int]) -> Look:
        """The one look there is."""
        return self.fixed


class ModelSource(Source):
    """A model with a scene. The shown world is that of the first look.

    Frames may be any of the scene: another number than the recipe's is what the user asks for.
    """

    def __init__(
        self,
        model: QueryGaussianModel,
        scene: Scene,
        views: ViewsConfig,
        frames: Sequence[int],
        title: str,
        notes: Sequence[str] = (),
    ) -> None:
        self.model, self.scene, self.views = model, scene, views
        self.frames, self.title, self.notes = tuple(frames), title, notes
        self.labels = [scene.label(frame) for frame in range(len(scene))]
        self.world = own_world(scene, self.frames, views)

    def look(self, frames: Sequence[int]) -> Look:
        """What the model makes of these frames, placed in the shown world."""
        if not frames:
            raise ValueError("a reconstruction needs an input photo: choose one at least")
        picked, _ = choose_frames(len(self.scene), len(frames), 1, frames, compare=())
        world = own_world(self.scene, picked, self.views)
        device = next(self.model.parameters()).device
        inputs = make_sample(self.scene, picked, (), self.views, mirror=False).inputs.to(device)
        place = Placement.between(world, self.world)
        labels = [self.labels[frame] for frame in picked]
        return look_inside(self.model, inputs, labels, picked, place)

    def cameras(self) -> Cameras | None:
        """Of all frames of the scene."""
        reference, scale = self.world
        own = self.scene.cameras
        c2w = scaled(relative_to(reference.double(), own.c2w.double()), scale.double())
        return Cameras(c2w, own.intrinsics.double(), own.size)


@dataclass(frozen=True)
class Wanted:
    """What the command was asked for, beside SOURCE; see `qgs view --help`."""

    photos: str | None = None
    scene: str | None = None
    frames: str | None = None
    inputs: int | None = None
    size: tuple[int, int] | None = None
    overrides: Sequence[str] = ()
    device: str = "cpu"


def open_source(name: str, wanted: Wanted) -> Source:
    """What `name` stands for: a PLY, a reconstruction's folder, a run folder or a model.

    Raises ValueError for options that do not apply to it, and as the readers do.
    """
    path = Path(name).expanduser()
    finished = path.is_dir() and (path / CAMERAS).is_file() and (path / PLY).is_file()
    if not finished and path.suffix.lower() != ".ply":
        return _of_model(name, wanted)
    if given := [field for field, value in vars(replace(wanted, device="")).items() if value]:
        raise ValueError(
            f"{listed(given)}: only for a model, and {name} holds Gaussians; leave that out"
        )
    return _of_finished(path, wanted.device) if finished else _of_ply(path)


def _of_ply(path: Path) -> Source:
    note = "A PLY file tells neither queries nor photos; name the model to see them."
    return FixedSource(Look(load_ply(path)), path.name, (note,))


def _of_finished(folder: Path, device: str) -> Source:
    found = read_finished(folder)
    title = f"{found.scene.name} ({folder.name})"
    views = views_in((torch.eye(4).double(), torch.ones(())), found.scene, tuple(found.inputs))
    labels = [found.scene.label(frame) for frame in found.inputs]
    plain = Look(found.gaussians, views, labels, tuple(found.inputs), background=found.background)
    refined = folder / REFINED
    there = (refined / CAMERAS).is_file()
    beside = [f"refined on photos: `qgs view {refined}`."] if there else []
    if note := _no_queries(found, folder):
        return FixedSource(plain, title, (note, *beside))
    try:
        with CheckpointFile(found.model) as file:
            model, recipe = file.model(device), file.recipe
        fixed = _finished_views(found, recipe.views)
        source = ModelSource(model, found.scene, fixed, found.inputs, title, beside)
        means = source.look(found.inputs).gaussians.means
    except (ValueError, OSError) as error:
        note = f"Its model cannot be used, so its queries are not shown: {error}"
        return FixedSource(plain, title, (note, *beside))
    if differs := _difference(means, found.gaussians.means):
        note = f"{found.model} makes other Gaussians today ({differs}): its queries are not shown."
        return FixedSource(plain, title, (note, *beside))
    return source


def _no_queries(found: Finished, folder: Path) -> str:
    """Why the queries of a reconstruction are not shown; "" where they are."""
    if found.changed == "refined":
        beside = folder.resolve().parent if folder.resolve().name == REFINED else None
        where = f": `qgs view {beside}`" if beside and (beside / CAMERAS).is_file() else ""
        return f"It was refined; only the prediction of the model has queries{where}."
    if found.changed == "tuned":
        return "It was tuned on its photos, so its model alone does not make these Gaussians."
    if not found.model:
        return "Its cameras.json names no model, so its queries are not known."
    if "://" in found.model:  # nothing is fetched because a file says so
        return f"Its queries are not shown; to fetch the model: `qgs view {found.model} PHOTOS`."
    return ""


def _finished_views(found: Finished, views: ViewsConfig) -> ViewsConfig:
    """How inputs come from the world of a reconstruction, which is scaled, into the model's.

    `constant` and `auto` have one factor for all inputs, now 1; `distance` has one for each choice
    of inputs. Where it gives another than 1 for the first ones, `--set views.scale` overrode it.
    """
    if views.scale == "distance":
        _, factor = own_world(found.scene, tuple(found.inputs), views)
        if math.isclose(float(factor), 1, rel_tol=1e-3):
            return views
    return views.model_copy(update={"scale": "constant", "scale_factor": 1.0})


def _difference(means: Tensor, others: Tensor) -> str:
    """How `means` differ from `others`, in words; "" where they are the same."""
    if means.shape != others.shape:
        return f"{means.shape[1]:,} instead of {others.shape[1]:,}"
    means, others = means.cpu().double(), others.cpu().double()
    spread = (others - others.median(1, keepdim=True).values).norm(dim=-1).median()
    far = float((means - others).norm(dim=-1).median() / spread.clamp_min(1e-12))
    return "" if far <= SAME else f"means differ by {far:.0%} of the scene"


def _of_model(name: str, wanted: Wanted) -> Source:
    with CheckpointFile(name) as file:
        model, recipe = file.model(wanted.device), file.recipe
    if wanted.overrides:
        recipe = resolve(recipe.tree, wanted.overrides)
    scene = _scene(recipe, wanted)
    chosen = None if wanted.frames is None else frame_list(wanted.frames, "--frames", scene)
    sample, _ = choose_sample(scene, recipe.views, wanted.inputs, chosen, None)
    found = Domain()
    found.see(sample.inputs.cameras, sample.targets.cameras)
    frames, trained = sample.input_frames, model.trained_on or Domain()
    notes = [*filter(None, (verdict(trained, found), framing(scene, frames[0])))]
    return ModelSource(model, scene, recipe.views, frames, f"{name}: {scene.name}", notes)


def _scene(recipe: Recipe, wanted: Wanted) -> Scene:
    """The scene at --photos, or the first test scene of the recipe's data, or the named one."""
    if wanted.photos is not None:
        return chosen_scene(recipe, wanted.photos, wanted.size, wanted.scene)[0]
    if recipe.data_config is None:
        raise ValueError("the checkpoint's recipe has no data: name a folder of photos after it")
    data = recipe.build_data()
    if wanted.size is not None:
        raise ValueError("--size is for photos: name a folder of them, or leave it out")
    if wanted.scene is not None:
        return named_scene(data, "the data of the recipe", wanted.scene)
    return data.scenes("test" if data.names("test") else "train")[0]
