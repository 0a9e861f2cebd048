"""Finished reconstructions, as `qgs reconstruct --out` writes them, and their models."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qgs.checkpoint.gaussians import load_ply
from qgs.checkpoint.model_file import CheckpointFile
from qgs.contracts import Scene, ViewsConfig
from qgs.data.images import open_rgb, to_tensor
from qgs.data.samples import own_world, views_in
from qgs.types import Cameras
from qgs_viewer.query_scene import NEUTRAL, QueryScene
from qgs_viewer.sources import ModelSource, Source

PLY = "gaussians.ply"
CAMERAS = "cameras.json"
"""Files in the folder of a finished reconstruction."""
REFINED = "refined"
"""The folder in it with the result of `--refine`."""
# Median distance of means, per spread of the scene, up to which a model made a PLY's Gaussians.
#
# A finished reconstruction keeps its photos in 8 bits, which moves means by some thousandths.
SAME = 0.02


def is_finished(folder: Path) -> bool:
    """Return if `folder` holds a finished reconstruction."""
    return (folder / CAMERAS).is_file() and (folder / PLY).is_file()


class FinishedScene(Scene):
    """The views that a reconstruction was compared with, as frames in its world."""

    def __init__(self, name: str, folder: Path, views: Sequence[dict[str, Any]]) -> None:
        self.name = name
        self._folder = folder
        self._views = views

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
            image = open_rgb(self._folder / "views" / name, NEUTRAL)
            # the render stands to the right of the photo
            pictures.append(np.asarray(image)[:height, :width])
        return to_tensor(np.stack(pictures))

    def label(self, frame: int) -> str:
        """The photo's file, or its number in the scene, not its place in cameras.json."""
        view = self._views[frame]
        return str(view.get("photo") or f"frame {view['frame']}")

    def frame_name(self, frame: int) -> str:
        """The photo's file, or its number in the scene."""
        return self.label(frame).removeprefix("frame ")


def read_finished(folder: Path) -> tuple[QueryScene, FinishedScene, Mapping[str, Any]]:
    """Read a reconstruction without its queries, its photos, and cameras.json.

    Raises ValueError with the file that is broken.
    """
    path = folder / CAMERAS
    gaussians = load_ply(folder / PLY)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        views = record["views"]
        scene = FinishedScene(str(record["scene"]), folder, views)
        inputs = tuple(place for place, view in enumerate(views) if view["kind"] == "input")
        # a missing picture fails now, not when a user asks for another input
        scene.images(range(len(views)))
        red, green, blue = (min(max(float(c), 0), 1) for c in record.get("background") or NEUTRAL)
        photos = views_in((torch.eye(4).double(), torch.ones(())), scene, inputs)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{path} is no record of a reconstruction ({type(error).__name__}: {error}); make it "
            "again with `qgs reconstruct`, or view the PLY alone"
        ) from error
    plain = QueryScene(gaussians, photos, inputs, background=(red, green, blue))
    return plain, scene, record


def open_finished(folder: Path, device: str) -> Source:
    """Open a reconstruction, with its queries where its model still makes the same Gaussians."""
    plain, scene, record = read_finished(folder)
    title = f"{scene.name} ({folder.name})"
    name = str(record.get("model") or "")
    notes = []
    if (folder / REFINED / CAMERAS).is_file():
        notes.append(f"refined on photos: `qgs view {folder / REFINED}`.")
    if note := _no_queries(record, name, folder):
        return Source(title, (note, *notes), plain)
    try:
        with CheckpointFile(name) as file:
            model = file.model(device)
            recipe = file.recipe
        # the stored cameras are in the model's world already
        views = _finished_views(scene, plain.frames, recipe.views)
        source = ModelSource(model, scene, views, plain.frames, title, notes)
        # a model file may have changed since, so what it makes is compared
        means = source.scene_of(plain.frames).gaussians.means
    except (ValueError, OSError) as error:
        note = f"Its model cannot be used, so its queries are not shown: {error}"
        return Source(title, (note, *notes), plain)
    if differs := _difference(means, plain.gaussians.means):
        note = f"{name} makes other Gaussians today ({differs}): its queries are not shown."
        return Source(title, (note, *notes), plain)
    return source


def _no_queries(record: Mapping[str, Any], model: str, folder: Path) -> str:
    """Say why the queries of a reconstruction are not shown; "" where they are."""
    if record.get("refinement"):
        folder = folder.resolve()
        # the prediction lies one folder up
        beside = folder.name == REFINED and is_finished(folder.parent)
        where = f": `qgs view {folder.parent}`" if beside else ""
        return f"It was refined; only the prediction of the model has queries{where}."
    if record.get("tuning"):
        return "It was tuned on its photos, so its model alone does not make these Gaussians."
    if not model:
        return "Its cameras.json names no model, so its queries are not known."
    # nothing is fetched because a file says so
    if "://" in model:
        return f"Its queries are not shown; to fetch the model: `qgs view {model} PHOTOS`."
    return ""


def _finished_views(scene: Scene, inputs: Sequence[int], views: ViewsConfig) -> ViewsConfig:
    """Return how inputs come from the world of a reconstruction, which is scaled, into the model's.

    `constant` and `auto` have one factor for all inputs, now 1; `distance` has one for each choice
    of inputs. Where it gives another than 1 for the first ones, `--set views.scale` overrode it.
    """
    if views.scale == "distance":
        _, factor = own_world(scene, tuple(inputs), views)
        if math.isclose(float(factor), 1, rel_tol=1e-3):
            return views
    return views.model_copy(update={"scale": "constant", "scale_factor": 1.0})


def _difference(means: Tensor, others: Tensor) -> str:
    """Say how `means` differ from `others`; "" where they are the same."""
    if means.shape != others.shape:
        return f"{means.shape[1]:,} instead of {others.shape[1]:,}"
    means = means.cpu().double()
    others = others.cpu().double()
    # a median: a few far Gaussians would hide any difference
    spread = (others - others.median(1, keepdim=True).values).norm(dim=-1).median()
    far = float((means - others).norm(dim=-1).median() / spread.clamp_min(1e-12))
    return "" if far <= SAME else f"means differ by {far:.0%} of the scene"
