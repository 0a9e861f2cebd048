"""The Gaussians, photos and cameras of a finished reconstruction."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from qgs.contracts import Scene
from qgs.io.gaussians import load_ply
from qgs.types import Cameras, Gaussians
from qgs_viewer.look import NEUTRAL, Background

PLY, CAMERAS = "gaussians.ply", "cameras.json"
"""What a folder of a finished reconstruction holds."""
REFINED = "refined"
"""The folder in it with what `--refine` made of it."""


@dataclass(frozen=True)
class Finished:
    """A reconstruction that `qgs reconstruct` wrote: its Gaussians and views, in its world.

    inputs: numbers of the input views in `scene`. model: what made the Gaussians, as it was named;
    "" where it does not tell. changed: what was done to them since. background: RGB in [0, 1] that
    they were made before.
    """

    gaussians: Gaussians
    scene: "FinishedScene"
    inputs: Sequence[int]
    model: str
    changed: Literal["", "tuned", "refined"] = ""
    background: Background = NEUTRAL


class FinishedScene(Scene):
    """The views that a reconstruction was compared with, as frames in its world."""

    def __init__(self, name: str, folder: Path, views: Sequence[dict[str, Any]]) -> None:
        self.name, self._folder, self._views = name, folder, views

    @property
    def cameras(self) -> Cameras:
        """All views, as cameras.json tells them."""
        c2w = torch.tensor([view["c2w"] for view in self._views], dtype=torch.float64)
        lenses = torch.tensor([view["intrinsics"] for view in self._views], dtype=torch.float64)
        height, width = self._views[0]["size"]
        return Cameras(c2w, lenses, (height, width))

    def images(self, frames: Sequence[int]) -> Tensor:
        """Photos, the left part of the pictures in views/."""
        height, width = self.cameras.size
        pictures = []
        for frame in frames:
            view = self._views[frame]
            name = f"{view['frame']:05d}_{view['kind'].split()[0]}.png"
            with Image.open(self._folder / "views" / name) as image:
                pixels = np.asarray(image.convert("RGB"))[:height, :width]
            pictures.append(torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255)
        return torch.stack(pictures)

    def label(self, frame: int) -> str:
        """The photo's file, or its number in the scene, not its place in cameras.json."""
        view = self._views[frame]
        return str(view.get("photo") or f"frame {view['frame']}")

    def frame_name(self, frame: int) -> str:
        """The photo's file, or its number in the scene."""
        view = self._views[frame]
        return str(view.get("photo") or view["frame"])


def read_finished(folder: Path) -> Finished:
    """What `qgs reconstruct --out FOLDER` wrote. Raises ValueError with the file that is broken."""
    record = folder / CAMERAS
    gaussians = load_ply(folder / PLY)
    try:
        told = json.loads(record.read_text(encoding="utf-8"))
        views = told["views"]
        scene = FinishedScene(str(told["scene"]), folder, views)
        inputs = [place for place, view in enumerate(views) if view["kind"] == "input"]
        scene.images(range(len(views)))  # so that a file that is missing is told now
        red, green, blue = (min(max(float(c), 0), 1) for c in told.get("background") or NEUTRAL)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{record} is no record of a reconstruction ({type(error).__name__}: {error}); make it "
            "again with `qgs reconstruct`, or view the PLY alone"
        ) from error
    changed = "refined" if told.get("refinement") else "tuned" if told.get("tuning") else ""
    model = str(told.get("model") or "")
    return Finished(gaussians, scene, inputs, model, changed, (red, green, blue))
