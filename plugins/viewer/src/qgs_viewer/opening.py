"""Open what `qgs view` shows: a file of Gaussians, a reconstruction, or a model with photos."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.models import CHECKPOINT
from qgs.cli.options import parse_size
from qgs.contracts import Scene, ViewsConfig
from qgs.data.images import decode_rgb, read_image, to_tensor
from qgs.data.samples import cameras_in, make_sample, own_world
from qgs.data.view_samplers import evenly
from qgs.domain import Domain, verdict
from qgs.geometry.poses import scaled
from qgs.model import QueryGaussianModel
from qgs.recipe import Recipe, resolve
from qgs.reconstruction.reconstruct import checked_window, choose_frames, reconstruct
from qgs.reconstruction.scale import at_factor, constant_scale
from qgs.reconstruction.scene_formats import about_origin, load_ply
from qgs.reconstruction.scenes import (
    GivenScene,
    Size,
    chosen_scene,
    frame_list,
    named_scene,
    read_photos,
)
from qgs.types import Cameras, Views, World
from qgs.wording import listed, one_line
from qgs_viewer.query_scene import NEUTRAL, QueryScene, explained

PLY = "gaussians.ply"
MADE = "scene.ply"
"""File of Gaussians that `qgs scene --out FOLDER` writes."""
_SCENES = (".ply", ".splat", ".spz", ".sog", ".glb")
# Photos that are shown beside a scene of `qgs scene`.
PHOTOS = 12
_VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
CAMERAS = "cameras.json"
"""File with the cameras, which `qgs reconstruct --out FOLDER` writes beside gaussians.ply."""
REFINED = "refined"
"""Name of the subfolder that `qgs refine` writes into a finished reconstruction."""
# Median distance of means, per spread of the scene, up to which a model made a PLY's Gaussians.
#
# A finished reconstruction keeps its photos in 8 bits, which moves means by some thousandths.
SAME = 0.02


@dataclass
class FixedSource:
    """Gaussians without a model, as content of the viewer.

    title: heading of the viewer. notes: remarks for the user. fixed: the Gaussians to show. The
    user cannot change the inputs, so frames and labels are empty.
    """

    title: str
    notes: Sequence[str]
    fixed: QueryScene
    frames = ()
    labels = ()

    def scene_of(self, frames: Sequence[int]) -> QueryScene:
        """Return `self.fixed`, whatever the photos `frames`."""
        return self.fixed


@dataclass
class ModelSource:
    """A model and a scene: the user may choose any photos of the scene as inputs.

    frames: indices, within the scene, of the input photos that the viewer uses at the start. title,
    notes: as in `FixedSource`.
    """

    model: QueryGaussianModel
    scene: Scene
    views: ViewsConfig
    frames: Sequence[int]
    title: str
    notes: Sequence[str] = ()

    @property
    def labels(self) -> list[str]:
        """A name for every photo of the scene."""
        return [*map(self.scene.label, range(len(self.scene)))]

    @cached_property
    def world(self) -> World:
        """World of the reconstruction from `frames`, which is that of the viewer.

        All later reconstructions are moved into this world.
        """
        return own_world(self.scene, tuple(self.frames), self.views)

    def scene_of(self, frames: Sequence[int]) -> QueryScene:
        """Return the scene reconstructed from the photos `frames`, placed in the viewer's world.

        Raises ValueError if `frames` is empty, has too many frames, or has a frame that does not
        exist or occurs twice.
        """
        if not frames:
            raise ValueError("a reconstruction needs input photos: choose at least one photo")
        # refuses frames that are not there, twice or too many
        picked, _ = checked_window(len(self.scene), frames)
        own, own_scale = own_world(self.scene, picked, self.views)
        reference, scale = self.world
        inputs = make_sample(self.scene, picked, (), self.views).inputs.to(self.model.device)
        # other inputs have another world, while the user's view stays
        pose = scaled(torch.linalg.inv(reference.double()) @ own.double(), scale)
        placement = (pose, float(scale) / float(own_scale))
        cameras = cameras_in(self.world, self.scene, picked)
        return explained(self.model, inputs, picked, placement, cameras)


Source = FixedSource | ModelSource
"""Content of the viewer."""


def photo_model(size: Size | None) -> str:
    """Return the name of the default model for a user's photos.

    size: (H, W) of the photos in pixels, if the user gives it.
    """
    # the larger models were trained on images of 128 pixels and more
    return "worlds/landmark-64" if size and min(size) < 128 else "worlds/landmark-256"


def holds_photos(path: Path) -> bool:
    """Return True if `path` is a folder without checkpoint, or a video."""
    if path.is_dir():
        return not any((path / name).is_file() for name in (CHECKPOINT, "recipe.yaml"))
    return path.is_file() and path.suffix.lower() in _VIDEOS


def open_source(name: str, device: str = "cpu", **options: Any) -> Source:
    """Open the file of Gaussians, the scene, the reconstruction, the model or the photos `name`.

    options: passed to `open_model`. Photos are reconstructed by `photo_model`. Raises ValueError if
    options are given for a file of Gaussians, a scene or a reconstruction, which take no options.
    Errors of the readers of files pass through.
    """
    path = Path(name).expanduser()
    finished = is_finished(path)
    made = (path / MADE).is_file()
    if not (made or finished or path.suffix.lower() in _SCENES):
        if options.get("photos") is None and holds_photos(path):
            options["photos"] = name
            name = photo_model(options.get("size"))
        return open_model(name, device, **options)
    if given := [option for option, value in options.items() if value]:
        raise ValueError(
            f"{listed(given)} can be given only for a model, but {name} holds finished Gaussians: "
            "leave the option out, or name a model"
        )
    if finished:
        return open_finished(path, device)
    if made:
        return open_made(path)
    note = "A file of Gaussians has neither queries nor photos; name the model to see them."
    # the browser gets float32
    gaussians, _ = about_origin(load_ply(path))
    return FixedSource(path.name, (note,), QueryScene(gaussians))


def open_model(
    name: str,
    device: str,
    photos: str | None = None,
    scene: str | None = None,
    frames: str | None = None,
    inputs: int | None = None,
    size: Size | None = None,
    overrides: Sequence[str] = (),
) -> Source:
    """Open a model on a scene of `photos`, by default on a test scene of the recipe's data.

    The other arguments are the options of `qgs view` with these names. scene: name of the scene;
    None takes the first. frames: indices or files of the input photos; None chooses them. inputs:
    number of photos to choose; None takes the number in the recipe. size: (H, W) of the photos in
    pixels. overrides: settings of `views`, as `KEY=VALUE`.
    """
    with CheckpointFile(name) as file:
        model = file.model(device)
        recipe = file.recipe
    if overrides:
        recipe = resolve(recipe.tree, overrides)
    views = recipe.views
    if photos is None:
        shown = _scene(recipe, size, scene)
        chosen = None if frames is None else frame_list(frames, "--frames", shown)
        given, compared = choose_frames(shown, views, inputs, chosen, None, model.trained_on)
        sample = make_sample(shown, given, compared, views)
        # users learn if these views are like those of the training
        seen = Domain()
        seen.see(sample.inputs.cameras, sample.targets.cameras)
        notes = [verdict(model.trained_on or Domain(), seen)]
    else:
        found = reconstruct(
            model,
            photos,
            inputs=inputs,
            frames=frames,
            size=size,
            scene=scene,
            overrides=overrides,
        )
        # inputs that are chosen later keep size and scale
        given = found.sample.input_frames
        shown, _ = chosen_scene(recipe, photos, found.sample.inputs.cameras.size, scene)
        notes = list(found.remarks)
        if found.size:
            notes.insert(0, f"{found.size.text}; --size sets another")
        if found.scale:
            notes.insert(0, f"{found.scale.text}; --scale sets another")
            views = constant_scale(views, found.scale.factor)
    return ModelSource(model, shown, views, given, f"{name}: {shown.name}", notes)


def _scene(recipe: Recipe, size: Size | None, name: str | None) -> Scene:
    """Return a scene of the recipe's data.

    name: name of the scene; None takes the first test scene. Raises ValueError if the recipe has no
    data, or if `size` is given.
    """
    if recipe.data_config is None:
        raise ValueError(
            "the checkpoint's recipe has no data to show: add a folder of photos after the "
            "checkpoint"
        )
    data = recipe.build_data()
    if size is not None:
        raise ValueError(
            "--size has an effect only on your own photos: give a folder of photos, or leave "
            "--size out"
        )
    if name is not None:
        return named_scene(data, "the data of the recipe", name)
    return data.scenes("test" if data.names("test") else "train")[0]


def open_made(folder: Path) -> Source:
    """Open the Gaussians that `qgs scene` wrote into `folder`, with some of their photos.

    If the photos are gone, a note says so. Raises the errors of `load_ply`.
    """
    gaussians, _ = about_origin(load_ply(folder / MADE))
    notes = []
    views = None
    try:
        record = json.loads((folder / "metrics.json").read_bytes())
        words = shlex.split(record["command"])
        size = parse_size(words[words.index("--size") + 1])
        # qgs scene PHOTOS
        views = read_photos(words[2], size=size, frames=evenly(record["refined_on"], PHOTOS))
        views = at_factor(views, record.get("factor", 1.0))
    except (OSError, ValueError, LookupError) as error:
        notes.append(f"The photos of the scene are not shown: {one_line(error)}")
    shown = QueryScene(gaussians, views, background=(0.0, 0.0, 0.0))
    return FixedSource(folder.name, notes, shown)


def is_finished(folder: Path) -> bool:
    """Return True if `folder` holds a finished reconstruction: gaussians.ply and cameras.json."""
    return (folder / CAMERAS).is_file() and (folder / PLY).is_file()


class FinishedScene(GivenScene):
    """Photos of a finished reconstruction, with cameras in the world of its Gaussians.

    records: the entries `views` of cameras.json. The photos are the left halves of the pictures in
    the subfolder views/ of `folder`.
    """

    def __init__(self, name: str, folder: Path, records: Sequence[dict[str, Any]]) -> None:
        c2w = torch.tensor([[view["c2w"] for view in records]], dtype=torch.float64)
        lenses = torch.tensor([[view["intrinsics"] for view in records]], dtype=torch.float64)
        height, width = records[0]["size"]
        pictures = []
        for view in records:
            file = f"{view['frame']:05d}_{view['kind'].split()[0]}.png"
            image = read_image(folder / "views" / file, decode_rgb)
            # the render stands to the right of the photo
            pictures.append(np.asarray(image)[:height, :width])
        photos = to_tensor(np.stack(pictures))[None]
        super().__init__(Views(photos, Cameras(c2w, lenses, (height, width))))
        self.name = name
        self._records = records

    def label(self, frame: int) -> str:
        """Return the file name of a photo; without one, text with its frame number.

        frame: index of the view in cameras.json. The frame number in the text is the index of the
        photo in the original scene, which may differ from `frame`.
        """
        view = self._records[frame]
        return str(view.get("photo") or f"frame {view['frame']}")


def open_finished(folder: Path, device: str) -> Source:
    """Open a finished reconstruction, with its queries if its model is known.

    If the model no longer makes the Gaussians of the PLY file, these are shown without queries, and
    a note says why. Raises a ValueError that names a broken file.
    """
    path = folder / CAMERAS
    gaussians = load_ply(folder / PLY)
    try:
        record = json.loads(path.read_bytes())
        views = record["views"]
        # all pictures are read: a missing one fails now, not when a user asks for another input
        scene = FinishedScene(str(record["scene"]), folder, views)
        inputs = tuple(place for place, view in enumerate(views) if view["kind"] == "input")
        red, green, blue = map(float, record.get("background") or NEUTRAL)
        photos = scene.views.select([*inputs]).to(torch.float32)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{path} does not describe a reconstruction ({type(error).__name__}: {error}); repeat "
            "`qgs reconstruct`, or view its PLY file alone"
        ) from error
    plain = QueryScene(gaussians, photos, inputs, background=(red, green, blue))
    title = f"{scene.name} ({folder.name})"
    notes = []
    if is_finished(folder / REFINED):
        notes.append(f"To view the refined Gaussians: `qgs view {folder / REFINED}`.")
    try:
        source = _with_queries(plain, scene, record, device)
    except (ValueError, OSError) as error:
        return FixedSource(title, [f"Queries are not shown: {error}", *notes], plain)
    source.title = title
    source.notes = notes
    return source


def _with_queries(
    plain: QueryScene, scene: FinishedScene, record: Mapping[str, Any], device: str
) -> ModelSource:
    """Return the reconstruction `plain` with its model, so that the queries can be shown.

    record: content of cameras.json. Raises ValueError or OSError if the model is unknown or cannot
    be read, or if it does not make the Gaussians of `plain` (any more).
    """
    for change in ("refinement", "tuning"):
        if record.get(change):
            raise ValueError(f"{change} changed the Gaussians, so the model no longer makes them.")
    name = str(record.get("model") or "")
    # nothing is fetched because a file says so
    if not name or "://" in name:
        raise ValueError(
            f"cameras.json must name a model on this machine (model: {name or 'not known'}); to "
            "see queries, use `qgs view MODEL PHOTOS`."
        )
    count = record.get("gaussians") and plain.gaussians.count
    with CheckpointFile(name, count) as file:
        model = file.model(device)
        # the stored cameras are in the model's world already
        views = constant_scale(file.recipe.views, 1.0)
    source = ModelSource(model, scene, views, plain.frames, "")
    # a model file may have changed since, so what it makes is compared
    made = source.scene_of(plain.frames).gaussians.means.cpu().double()
    means = plain.gaussians.means.cpu().double()
    # medians: a few far Gaussians would hide any difference
    spread = (means - means.median(1, keepdim=True).values).norm(dim=-1).median()
    if made.shape != means.shape or (made - means).norm(dim=-1).median() > SAME * spread:
        raise ValueError(f"the model {name} has changed and no longer makes these Gaussians.")
    return source
