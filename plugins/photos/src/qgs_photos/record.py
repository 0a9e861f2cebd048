"""Read the folder that `qgs reconstruct` wrote: Gaussians, cameras and their world."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from qgs.reconstruction.scene_formats import load_ply
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Gaussians, World

GAUSSIANS = "gaussians.ply"
CAMERAS = "cameras.json"


@dataclass(frozen=True)
class Record:
    """A finished reconstruction, in the world coordinates of its Gaussians.

    folder: folder of the files. scene: name of the scene. model: checkpoint of the model, "" if
    unknown. tuning: settings of `--tune`; None without this option. world: reference pose (4, 4)
    and scale that map the world of the photos to that of the Gaussians (see `own_world`). inputs:
    indices of the input frames. compared: indices of the frames with which renders were compared.
    cameras: (1, V), those of `inputs`, then those of `compared`. photos: photo file of each frame,
    by the frame's index; frames whose file is unknown are missing. renderer: renderer options that
    set the background of the model.
    """

    folder: Path
    scene: str
    model: str
    tuning: Mapping[str, Any] | None
    world: World
    inputs: tuple[int, ...]
    compared: tuple[int, ...]
    photos: Mapping[int, str]
    cameras: Cameras
    renderer: AutoRenderer.Config

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians (1, G), read from the folder."""
        return load_ply(self.folder / GAUSSIANS)


def has_record(folder: Path) -> bool:
    """Return whether `folder` holds a reconstruction: gaussians.ply and cameras.json."""
    return (folder / CAMERAS).is_file() and (folder / GAUSSIANS).is_file()


def read_record(folder: Path) -> Record:
    """Read a reconstruction from `folder`. Raises ValueError if cameras.json is damaged."""
    file = folder / CAMERAS
    try:
        return _parsed(folder, json.loads(file.read_bytes()))
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{file} does not describe a reconstruction ({type(error).__name__}: {error}): repeat "
            "`qgs reconstruct`"
        ) from error


def _parsed(folder: Path, data: dict[str, Any]) -> Record:
    # inputs first, whatever the order in the file: `Record.cameras` promises it
    views = sorted(data["views"], key=lambda view: view["kind"] != "input")
    frames = [view["frame"] for view in views]
    inputs = sum(view["kind"] == "input" for view in views)
    height, width = views[:inputs][0]["size"]
    reference = torch.tensor(data["to_photos"]["reference_c2w"], dtype=torch.float64)
    scale = torch.tensor(data["to_photos"]["scale"], dtype=torch.float64)
    # of models whose background is their default nothing is recorded
    background = data.get("background")
    options = {"background": tuple(background)} if background else {}
    return Record(
        folder=folder,
        scene=data["scene"],
        model=data.get("model") or "",
        tuning=data.get("tuning"),
        world=(reference, scale),
        inputs=tuple(frames[:inputs]),
        compared=tuple(frames[inputs:]),
        photos={view["frame"]: view["photo"] for view in views if view.get("photo")},
        cameras=Cameras(
            torch.tensor([view["c2w"] for view in views])[None],
            torch.tensor([view["intrinsics"] for view in views])[None],
            (height, width),
        ),
        renderer=AutoRenderer.Config.model_validate(options),
    )


def factor_of(file: Path) -> float:
    """Return by how much positions in a scene's file are larger than in its photos' world.

    `qgs scene` notes this in metrics.json beside the file; it is 1 for other files.
    """
    record = file.with_name("metrics.json")
    return json.loads(record.read_bytes()).get("factor", 1.0) if record.is_file() else 1.0
