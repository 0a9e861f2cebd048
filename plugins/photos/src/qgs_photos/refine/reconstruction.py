"""A reconstruction refined on the photos of its scene."""

from collections.abc import Sequence
from dataclasses import asdict, replace

from rich.console import Console

from qgs.contracts import Scene
from qgs.data.samples import Sample, training_frames, views_in
from qgs.metrics.images import Psnr
from qgs.reconstruction.result import Reconstruction, reconstruct_sample
from qgs.types import Views
from qgs_photos.refine.refining import refine


def refine_reconstruction(
    start: Reconstruction,
    scene: Scene,
    seconds: float,
    *,
    count: int | None = None,
    inputs_only: bool = False,
    seen: Sequence[int] = (),
    console: Console,
) -> Reconstruction:
    """Refine the Gaussians of `start` on photos of `scene`, at the size of these photos.

    seconds, count: as in `refine`. inputs_only: optimise on the input photos alone; otherwise on
    all photos that are neither compared with nor held out of training. seen: frames that the model
    was trained on.
    """
    sample, photos, frames = _photos(scene, start, inputs_only)
    compared = sample.targets if sample.target_frames else None
    result = refine(
        start.gaussians, photos, seconds, count=count, compared=compared,
        renderer=start.model.renderer, console=console,
    )  # fmt: skip
    ended = f", ended by {result.stopped_by}" if result.stopped_by else ""
    height, width = photos.cameras.size
    console.print(
        f"refined for {result.seconds:.1f} s{ended}: {result.steps} steps on {len(frames)} photos "
        f"of {width} x {height} pixels, {start.gaussians.count:,} -> {result.gaussians.count:,} "
        "Gaussians",
        highlight=False,
        soft_wrap=True,
    )
    record = {
        "seconds": result.seconds,
        "steps": result.steps,
        "frames": frames,
        "photos": [scene.frame_name(frame) for frame in frames],
        "stopped_by": result.stopped_by,
        "curve": [asdict(point) for point in result.curve],
    }
    found = reconstruct_sample(
        start.model, sample, start.world, seen, result.gaussians, start.tuning, record
    )
    remarks = found.worse_than_nearest, _worse_than_before(start, found)
    return replace(found, remarks=[*filter(None, remarks)])


def _worse_than_before(start: Reconstruction, found: Reconstruction) -> str:
    """A remark where the compared photos are nearer to the prediction than to its refinement."""
    # PSNR falls with resolution: other sizes (--refine-size) are not compared
    if start.rendering.rgb.shape != found.rendering.rgb.shape:
        return ""
    means = [
        sum(novel) / len(novel)
        for result in (start, found)
        if (novel := [score.psnr for score in result.scores if score.kind != "input"])
    ]
    shown = Psnr.column.shown
    if not means or not Psnr.column.beats(*means):
        return ""
    return (
        f"the prediction is better on the compared photos, {shown(means[0])} against "
        f"{shown(means[1])} dB: refine for longer (--refine SECONDS), or keep the prediction"
    )


def _photos(
    scene: Scene, start: Reconstruction, inputs_only: bool
) -> tuple[Sample, Views, list[int]]:
    """The sample of `start` at the size of `scene`, the photos to optimise on, and their frames.

    Held-out photos are compared with all together, unless others were named; but for inputs.
    """
    inputs, targets = start.sample.input_frames, start.sample.target_frames
    if targets and {*targets} < {*scene.held_out}:  # of the whole scene, not of a window
        targets = tuple(sorted({*scene.held_out} - {*inputs}))
    usable = {*inputs} if inputs_only else {*training_frames(scene), *inputs} - {*targets}
    frames = sorted(usable)
    every = views_in(start.world, scene, (*frames, *targets)).to(start.gaussians.means.device)
    photos, compared = every.select(slice(len(frames))), every.select(slice(len(frames), None))
    own = photos.select([frames.index(frame) for frame in inputs])
    names = {frame: scene.frame_name(frame) for frame in (*inputs, *targets)}
    parts = {"inputs": own, "targets": compared, "target_frames": targets, "names": names}
    return replace(start.sample, **parts), photos, frames
