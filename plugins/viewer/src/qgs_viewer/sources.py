"""From what a user names to something that gives looks: a PLY, a reconstruction, a model."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from qgs.checkpoint.gaussians import load_ply
from qgs.checkpoint.model_file import CheckpointFile
from qgs.contracts import Scene, ViewsConfig
from qgs.data.images import framing
from qgs.data.recognition import is_training_data
from qgs.data.samples import make_sample, own_world, views_in
from qgs.domain import Domain, verdict
from qgs.geometry.poses import relative_to, scaled
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs.reconstruction.result import checked_window, choose_sample
from qgs.reconstruction.scale import ScaleSearch, photo_settings
from qgs.reconstruction.scenes import choice, chosen_scene, frame_list, named_scene
from qgs.types import Cameras
from qgs.wording import listed
from qgs_viewer.look import NEUTRAL, Look, look_inside
from qgs_viewer.placement import Placement
from qgs_viewer.scales import summary

PLY, CAMERAS = "gaussians.ply", "cameras.json"
"""Files in the folder of a finished reconstruction."""
REFINED = "refined"
"""The folder in it with the result of `--refine`."""
SAME = 0.02
"""Median distance of means, per spread of the scene, up to which a model made a PLY's Gaussians.

A finished reconstruction keeps its photos in 8 bits, which moves means by some thousandths."""


class Source:
    """Something to look at: Gaussians of no known model, whose inputs cannot be changed.

    notes: remarks for the user. frames: of the inputs at first. labels: of all frames; none where
    the inputs cannot be changed.
    """

    frames: Sequence[int] = ()
    labels: Sequence[str] = ()

    def __init__(self, title: str, notes: Sequence[str] = (), fixed: Look | None = None) -> None:
        self.title, self.notes, self.fixed = title, notes, fixed

    def look(self, frames: Sequence[int]) -> Look:
        """The scene as made of these frames. Raises ValueError for frames that do not fit."""
        assert self.fixed is not None
        return self.fixed

    def cameras(self) -> Cameras | None:
        """Cameras (F,) of all frames in the shown world; None without."""
        return None


class ModelSource(Source):
    """A model with a scene, of any number of its frames. The first look's world is shown."""

    def __init__(
        self,
        model: QueryGaussianModel,
        scene: Scene,
        views: ViewsConfig,
        frames: Sequence[int],
        title: str,
        notes: Sequence[str] = (),
    ) -> None:
        super().__init__(title, notes)
        self.model, self.scene, self.views = model, scene, views
        self.frames = tuple(frames)
        self.labels = [scene.label(frame) for frame in range(len(scene))]
        self.world = own_world(scene, self.frames, views)

    def look(self, frames: Sequence[int]) -> Look:
        """What the model makes of these frames, placed in the shown world."""
        if not frames:
            raise ValueError("a reconstruction needs an input photo: choose one at least")
        picked, _ = checked_window(len(self.scene), frames)
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
    """Options of `qgs view`."""

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
    if finished:
        return _of_finished(path, wanted.device)
    note = "A PLY file holds neither queries nor photos; name the model to see them."
    return Source(path.name, (note,), Look(load_ply(path)))


class FinishedScene(Scene):
    """The views that a reconstruction was compared with, as frames in its world."""

    def __init__(self, name: str, folder: Path, views: Sequence[dict[str, Any]]) -> None:
        self.name, self._folder, self._views = name, folder, views

    @property
    def cameras(self) -> Cameras:
        """All views of cameras.json."""
        c2w = torch.tensor([view["c2w"] for view in self._views], dtype=torch.float64)
        lenses = torch.tensor([view["intrinsics"] for view in self._views], dtype=torch.float64)
        height, width = self._views[0]["size"]
        return Cameras(c2w, lenses, (height, width))

    def images(self, frames: Sequence[int]) -> Tensor:
        """Photos, the left part of the pictures in views/."""
        height, width = self.cameras.size
        pictures = []
        for view in (self._views[frame] for frame in frames):
            name = f"{view['frame']:05d}_{view['kind'].split()[0]}.png"
            with Image.open(self._folder / "views" / name) as image:
                pixels = np.array(image.convert("RGB"))[:height, :width]
            pictures.append(torch.from_numpy(pixels).permute(2, 0, 1).float() / 255)
        return torch.stack(pictures)

    def label(self, frame: int) -> str:
        """The photo's file, or its number in the scene, not its place in cameras.json."""
        view = self._views[frame]
        return str(view.get("photo") or f"frame {view['frame']}")

    def frame_name(self, frame: int) -> str:
        """The photo's file, or its number in the scene."""
        return self.label(frame).removeprefix("frame ")


def read_finished(folder: Path) -> tuple[Look, FinishedScene, Mapping[str, Any]]:
    """What `qgs reconstruct --out FOLDER` wrote, the look without queries, and cameras.json.

    Raises ValueError with the file that is broken.
    """
    path, gaussians = folder / CAMERAS, load_ply(folder / PLY)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        views = record["views"]
        scene = FinishedScene(str(record["scene"]), folder, views)
        inputs = tuple(place for place, view in enumerate(views) if view["kind"] == "input")
        scene.images(range(len(views)))  # fails now where a picture is missing
        red, green, blue = (min(max(float(c), 0), 1) for c in record.get("background") or NEUTRAL)
        photos = views_in((torch.eye(4).double(), torch.ones(())), scene, inputs)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{path} is no record of a reconstruction ({type(error).__name__}: {error}); make it "
            "again with `qgs reconstruct`, or view the PLY alone"
        ) from error
    labels = [scene.label(frame) for frame in inputs]
    look = Look(gaussians, photos, labels, inputs, background=(red, green, blue))
    return look, scene, record


def _of_finished(folder: Path, device: str) -> Source:
    plain, scene, record = read_finished(folder)
    title, name = f"{scene.name} ({folder.name})", str(record.get("model") or "")
    there = (folder / REFINED / CAMERAS).is_file()
    beside = [f"refined on photos: `qgs view {folder / REFINED}`."] if there else []
    if note := _no_queries(record, name, folder):
        return Source(title, (note, *beside), plain)
    try:
        with CheckpointFile(name) as file:
            model, recipe = file.model(device), file.recipe
        views = _finished_views(scene, plain.frames, recipe.views)
        source = ModelSource(model, scene, views, plain.frames, title, beside)
        means = source.look(plain.frames).gaussians.means
    except (ValueError, OSError) as error:
        note = f"Its model cannot be used, so its queries are not shown: {error}"
        return Source(title, (note, *beside), plain)
    if differs := _difference(means, plain.gaussians.means):
        note = f"{name} makes other Gaussians today ({differs}): its queries are not shown."
        return Source(title, (note, *beside), plain)
    return source


def _no_queries(record: Mapping[str, Any], model: str, folder: Path) -> str:
    """Why the queries of a reconstruction are not shown; "" where they are."""
    if record.get("refinement"):
        above, name = folder.resolve().parent, folder.resolve().name
        beside = name == REFINED and (above / CAMERAS).is_file()
        where = f": `qgs view {above}`" if beside else ""
        return f"It was refined; only the prediction of the model has queries{where}."
    if record.get("tuning"):
        return "It was tuned on its photos, so its model alone does not make these Gaussians."
    if not model:
        return "Its cameras.json names no model, so its queries are not known."
    if "://" in model:  # nothing is fetched because a file says so
        return f"Its queries are not shown; to fetch the model: `qgs view {model} PHOTOS`."
    return ""


def _finished_views(scene: Scene, inputs: Sequence[int], views: ViewsConfig) -> ViewsConfig:
    """How inputs come from the world of a reconstruction, which is scaled, into the model's.

    `constant` and `auto` have one factor for all inputs, now 1; `distance` has one for each choice
    of inputs. Where it gives another than 1 for the first ones, `--set views.scale` overrode it.
    """
    if views.scale == "distance":
        _, factor = own_world(scene, tuple(inputs), views)
        if math.isclose(float(factor), 1, rel_tol=1e-3):
            return views
    return views.model_copy(update={"scale": "constant", "scale_factor": 1.0})


def _difference(means: Tensor, others: Tensor) -> str:
    """How `means` differ from `others`; "" where they are the same."""
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
    trained = model.trained_on or Domain()
    own = wanted.photos is None or is_training_data(wanted.photos, recipe.data_config)
    search = ScaleSearch(model, photo_settings(recipe.views, own, wanted.overrides))
    sample, _ = choose_sample(scene, recipe.views, wanted.inputs, chosen, None, trained, search)
    found = Domain()
    found.see(sample.inputs.cameras, sample.targets.cameras)
    frames, scales = sample.input_frames, [*search.found.values()]
    notes = [
        *([summary(scales)] if scales else []),
        *([choice(sample, scene, compares=False)] if wanted.photos else []),
        verdict(trained, found, ["scale"] if scales else []),
        *(scale.poor for scale in scales),
        framing(scene, frames[0]),
    ]
    notes = [note for note in notes if note]
    # inputs that are chosen later keep the scale
    views = search(scene, frames, sample.target_frames)
    return ModelSource(model, scene, views, frames, f"{name}: {scene.name}", notes)


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
