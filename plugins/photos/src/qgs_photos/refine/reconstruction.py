"""Open a finished reconstruction, and refine it on the photos of its scene."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console

from qgs.checkpoint.model_file import load
from qgs.contracts import Frames, Scene
from qgs.data.samples import Sample, cameras_in, views_in
from qgs.data.view_samplers import training_frames
from qgs.recipe import resolve
from qgs.reconstruction.result import Reconstruction, reconstruct_sample
from qgs.reconstruction.scenes import Size, chosen_scene
from qgs.terminal import print_lines
from qgs.types import Views
from qgs.wording import listed
from qgs_photos.record import Record, has_record, read_record
from qgs_photos.refine.refining import RefinedScene, refine
from qgs_photos.refine.surroundings import edge_color, surrounded

# JSON keeps float32 poses whole; photos whose poses were made again differ by far more.
_SAME_POSE = 1e-3


def opened_reconstruction(
    folder: Path, photos: str, size: Size | None, name: str | None, device: str
) -> tuple[Reconstruction, Scene, Sequence[int]]:
    """Open the reconstruction that `qgs reconstruct` wrote into `folder`, and its photos.

    Returns the reconstruction, the scene with photos of `size`, and the indices of the photos on
    which the reconstruction's model was trained.

    size: (H, W) of the photos in pixels; None takes that of the reconstruction. name: name of the
    scene if `photos` holds several; None takes that of the reconstruction. Raises FileNotFoundError
    if `folder` holds no reconstruction, ValueError if its model is unknown or it was made from
    other photos, and the errors of the readers of model and photos.
    """
    if not has_record(folder):
        raise FileNotFoundError(
            f"{folder} has no gaussians.ply with cameras.json: give a folder that "
            "`qgs reconstruct` wrote"
        )
    record = read_record(folder)
    if not record.model:
        raise ValueError(
            f"{folder} was made by a model that is not in a file: save the model and reconstruct "
            "again, or call qgs_photos.refine.refine in Python"
        )
    model = load(record.model, device)
    recipe = resolve(model.recipe or {})
    wanted = name or record.scene
    # At the recorded size, so that the scores before are those of the reconstruction
    scene, seen = chosen_scene(recipe, photos, record.cameras.size, wanted)
    # Photos that were named to be compared with are the only ones that stay aside, and with none
    # compared all are refined on; the record does not say so, its frames do.
    default = bool(record.compared) and {*record.compared} <= {*scene.held_out}
    if not default:
        scene, seen = chosen_scene(recipe, photos, record.cameras.size, wanted, holdout=False)
    refuse_other_photos(record, scene, photos)
    count = len(record.inputs)
    views = views_in(record.world, scene, (*record.inputs, *record.compared))
    sample = Sample(
        scene=scene.name,
        inputs=views.select(slice(count)),
        targets=views.select(slice(count, None)),
        input_frames=record.inputs,
        target_frames=record.compared,
        world=record.world,
        names=record.photos,
    )
    start = reconstruct_sample(model, sample, seen or (), record.gaussians.to(device))
    start = replace(start, tuning=record.tuning)
    if size is not None:
        scene, seen = chosen_scene(recipe, photos, size, wanted, holdout=default)
    return start, scene, seen or ()


def refuse_other_photos(record: Record, scene: Scene, photos: str) -> None:
    """Raise ValueError unless the photos and poses of `scene` are those of the reconstruction.

    photos: name of the photos' folder, for the message.
    """
    frames = (*record.inputs, *record.compared)
    expected = [record.photos.get(frame, str(frame)) for frame in frames]
    found = [scene.frame_name(frame) for frame in frames if frame < len(scene)]
    if found == expected:
        poses = cameras_in(record.world, scene, frames).c2w
        if torch.allclose(poses, record.cameras.c2w, _SAME_POSE, _SAME_POSE):
            return
    raise ValueError(
        f"{photos} does not hold the photos from which {record.folder} was made, or their poses "
        f"have changed; the photos were {listed(expected, 3)}: give these photos, or reconstruct "
        "again"
    )


def refine_reconstruction(
    start: Reconstruction,
    scene: Scene,
    seen: Sequence[int],
    seconds: float,
    count: int | None,
    inputs_only: bool,
    console: Console,
) -> Reconstruction:
    """Refine the Gaussians of the reconstruction `start` on photos of `scene`.

    seen: indices of photos on which the model was trained. seconds: time of the optimisation.
    count: number of Gaussians in the result; None keeps the number of `start`. inputs_only:
    optimise only on the input photos; False takes all photos except those held out of training and
    those with which the result is compared.
    """
    frames, targets = _chosen_frames(scene, start, inputs_only)
    every = views_in(start.sample.world, scene, (*frames, *targets)).to(
        start.gaussians.means.device
    )
    photos = every.select(slice(len(frames)))
    compared = every.select(slice(len(frames), None))
    color = edge_color(photos)
    renderer = start.model.renderer
    options = renderer.config.model_copy(update={"background": color})
    refined = refine(
        start.gaussians,
        photos,
        seconds,
        count=count,
        renderer=type(renderer)(options),
        console=console,
    )
    _tell(start, refined, photos, console)
    inputs = start.sample.input_frames
    sample = replace(
        start.sample,
        inputs=photos.select([frames.index(frame) for frame in inputs]),
        targets=compared,
        target_frames=targets,
        names={frame: scene.frame_name(frame) for frame in (*inputs, *targets)},
    )
    record = {
        "seconds": refined.seconds,
        "steps": refined.steps,
        "frames": frames,
        "photos": [scene.frame_name(frame) for frame in frames],
        "stopped_by": refined.stopped_by,
    }
    whole = surrounded(refined.gaussians, photos, color)
    found = reconstruct_sample(start.model, sample, seen, whole)
    worse = found.worse_than_nearest
    remarks = [worse] if worse else []
    return replace(found, tuning=start.tuning, refinement=record, remarks=remarks)


def _chosen_frames(
    scene: Scene, start: Reconstruction, inputs_only: bool
) -> tuple[list[int], Frames]:
    """Return the indices of the photos to optimise on, and of the held-out photos to score."""
    inputs = start.sample.input_frames
    targets = start.sample.target_frames
    # A reconstruction is compared near its inputs; its refinement covers the whole scene, and is
    # compared with all held-out photos, unless the user named some.
    if targets and {*targets} < {*scene.held_out}:
        targets = tuple(sorted({*scene.held_out} - {*inputs}))
    # inputs are optimised on even where they are held out: the model saw them
    usable = {*inputs} if inputs_only else {*training_frames(scene), *inputs}
    return sorted(usable - {*targets}), targets


def _tell(start: Reconstruction, refined: RefinedScene, photos: Views, console: Console) -> None:
    height, width = photos.cameras.size
    ended = f", ended by {refined.stopped_by}" if refined.stopped_by else ""
    line = (
        f"refined for {refined.seconds:.1f} s{ended}: {refined.steps} steps on "
        f"{photos.images.shape[1]} photos of {width} x {height} pixels, "
        f"{start.gaussians.count:,} -> {refined.gaussians.count:,} Gaussians"
    )
    print_lines(console, [line])
