"""Which frames of a photo folder are reconstructed from, and which are compared with."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.data.sampling import Sample
from qgs.drawing.figures import figure_picture, grid_figure
from qgs.drawing.images import (
    Picture,
    depth_picture,
    depth_range,
    finer,
    rgb_picture,
    side_by_side,
    write_gif,
    write_png,
)
from qgs.io.files import replacing_entries, write_text
from qgs.io.ply import write_ply
from qgs.metrics import mean_colour, nearest_input, psnr
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians, Rendering


def choose_frames(
    total: int,
    inputs: int,
    span: int,
    frames: Sequence[int] | None = None,
    compare: Sequence[int] | None = None,
    novel: int = 6,
    held_out: Sequence[int] = (),
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Input frames and novel frames, from 0 to total - 1.

    frames: the inputs; None spreads `inputs` of them over `span` frames in the middle of all, both
    ends included, or over all when there are fewer. compare: the novel ones; None takes at most
    `novel`, evenly spread over the frames between the inputs. held_out: frames that the model was
    not trained on, of a folder that it was trained on; the inputs are then chosen from the others,
    and compared are those between the inputs, where there are any.
    Raises ValueError for frames that do not exist, come twice, or are both input and novel.
    """
    usable = [frame for frame in range(total) if frame not in held_out]
    chosen = _middle(usable, inputs, max(span, inputs)) if frames is None else tuple(frames)
    if compare is None:
        between = [f for f in range(min(chosen), max(chosen) + 1) if f not in chosen]
        between = [f for f in between if f in held_out] or between
        compare = _evenly(between, min(novel, len(between)))
    _check([*chosen, *compare], total)
    return chosen, tuple(compare)


def _middle(frames: Sequence[int], count: int, span: int) -> tuple[int, ...]:
    if count > len(frames):
        raise ValueError(f"{count} input views were asked for, but there are {len(frames)} photos")
    span = min(span, len(frames))
    first = (len(frames) - span) // 2
    return _evenly(frames[first : first + span], count)


def _evenly(frames: Sequence[int], count: int) -> tuple[int, ...]:
    """`count` of `frames`, the first and the last among them; one alone is the middle one."""
    last = len(frames) - 1
    places = np.linspace(0, last, count).round() if count > 1 else np.full(count, last // 2)
    return tuple(frames[int(place)] for place in places)


def _check(frames: Sequence[int], total: int) -> None:
    missing = [frame for frame in frames if not 0 <= frame < total]
    if missing:
        raise ValueError(f"frames {missing} do not exist; the photos are 0..{total - 1}")
    twice = sorted({frame for frame in frames if list(frames).count(frame) > 1})
    if twice:
        raise ValueError(f"frames {twice} are named twice; inputs and compared frames must differ")


def orbit(inputs: Cameras, depth: float, frames: int, sway: float = 0.12) -> Cameras:
    """A loop (1, frames) that runs past the input cameras (1, V), there and back.

    The base path is the input poses under a Gaussian kernel, so it has no corners. Around it the
    camera sways by `sway` times `depth`, and looks at what lies `depth` world units ahead.
    """
    angles = torch.arange(frames, device=inputs.c2w.device) * (2 * math.pi / frames)
    poses = _smoothed(inputs.c2w[0], (1 - angles.cos()) / 2)
    right, down, forward, centre = poses[:, :3].unbind(-1)
    focus = centre + depth * forward
    reach = sway * depth
    eye = centre + reach * angles.sin()[:, None] * right
    eye = eye - reach / 2 * angles.cos()[:, None] * down
    c2w = look_at(eye, focus - eye, down)
    intrinsics = inputs.intrinsics[:, :1].expand(1, frames, 4)
    return Cameras(c2w[None], intrinsics, inputs.size)


def look_at(eye: Tensor, forward: Tensor, down: Tensor) -> Tensor:
    """OpenCV poses c2w (..., 4, 4) at eye (..., 3), looking along `forward`, upright by `down`."""
    forward = F.normalize(forward, dim=-1)
    down = F.normalize(down - (down * forward).sum(-1, keepdim=True) * forward, dim=-1)
    right = torch.linalg.cross(down, forward)
    top = torch.stack([right, down, forward, eye], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def _smoothed(c2w_V44: Tensor, times_T: Tensor) -> Tensor:
    """Poses (T, 4, 4) at times from 0, the first input, to 1, the last."""
    count = c2w_V44.shape[0]
    steps = times_T[:, None] * (count - 1) - torch.arange(count, device=times_T.device)
    weights_TV = torch.softmax(-0.5 * (steps / 0.6) ** 2, -1)
    mean = torch.einsum("tv,vij->tij", weights_TV, c2w_V44)
    _, down, forward, centre = mean[:, :3].unbind(-1)
    return look_at(centre, forward, down)


ORBIT_FRAMES = 48
ORBIT_SIDE = 320
FRAMES_PER_SECOND = 16
OVERVIEW_COLUMNS = 8

KINDS = ("input", "novel", "seen in training")
"""A compared view of a folder that the model was trained on is novel if it was held out."""

BASELINES = {"nearest input": nearest_input, "mean colour": mean_colour}


@dataclass(frozen=True)
class ViewScore:
    """One rendered view against its photo; all PSNR in dB.

    kind: one of KINDS. baselines: PSNR of the nearest input view and of the inputs' mean colour;
    empty for inputs.
    """

    frame: int
    kind: str
    psnr: float
    baselines: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_input(self) -> bool:
        """Whether the model saw this photo as an input."""
        return self.kind == "input"


@dataclass(frozen=True)
class Reconstruction:
    """Gaussians (1, G) of a sample, and what its input and target cameras see of them.

    world: reference pose (4, 4) and scale of the sample's world, as `own_world` gives them. tuning:
    how the tokens were tuned on the inputs, as plain values; None where they were not.
    """

    sample: Sample
    gaussians: Gaussians
    rendering: Rendering
    scores: list[ViewScore]
    world: tuple[Tensor, Tensor]
    tuning: Mapping[str, Any] | None = None


@torch.no_grad()
def reconstruct(
    model: QueryGaussianModel,
    sample: Sample,
    world: tuple[Tensor, Tensor],
    seen: Collection[int] = (),
    tuned: Gaussians | None = None,
    tuning: Mapping[str, Any] | None = None,
) -> Reconstruction:
    """Gaussians from the inputs of `sample`, rendered from its inputs, then its targets.

    world, tuning: see `Reconstruction`. seen: frames that the model was trained on. tuned: the
    Gaussians of tuned tokens, None for the model's own.
    """
    gaussians: Gaussians = model(sample.inputs).gaussians if tuned is None else tuned
    rendering = model.render(gaussians, _cameras(sample))
    photos = torch.cat([sample.inputs.images, sample.targets.images], 1)
    quality = psnr(rendering.rgb[0], photos[0]).tolist()
    inputs = len(sample.input_frames)
    scores = [
        ViewScore(frame, "input", value)
        for frame, value in zip(sample.input_frames, quality[:inputs], strict=True)
    ]
    baselines = _baselines(sample)
    for index, frame in enumerate(sample.target_frames):
        kind = "seen in training" if frame in seen else "novel"
        others = {name: values[index] for name, values in baselines.items()}
        scores.append(ViewScore(frame, kind, quality[inputs + index], others))
    return Reconstruction(sample, gaussians, rendering, scores, world, tuning)


def _baselines(sample: Sample) -> dict[str, list[float]]:
    """PSNR of each baseline on each target."""
    truth = sample.targets.images
    return {
        name: psnr(baseline(sample.inputs, sample.targets.cameras), truth)[0].tolist()
        for name, baseline in BASELINES.items()
    }


def write_reconstruction(
    model: QueryGaussianModel, reconstruction: Reconstruction, out: Path
) -> list[Path]:
    """Write gaussians.ply, overview.png, views/, depth/, orbit.gif and cameras.json into `out`.

    views/ holds photo and render side by side. Everything is in the normalised world of the model,
    in which cameras.json tells the cameras, and how that world lies in the photos'. Earlier files
    and folders of these names are replaced, all at the end.
    """
    with replacing_entries(out) as fresh:
        write_ply(reconstruction.gaussians, fresh / "gaussians.ply")
        _write_views(reconstruction, fresh)
        path = _write_orbit(model, reconstruction, fresh / "orbit.gif")
        record = json.dumps(_camera_record(reconstruction, path), indent=1)
        write_text(fresh / "cameras.json", record)
        names = sorted(entry.name for entry in fresh.iterdir())
    return [out / name for name in names]


def _write_views(reconstruction: Reconstruction, out: Path) -> None:
    sample, rendering = reconstruction.sample, reconstruction.rendering
    photos = [rgb_picture(i) for i in (*sample.inputs.images[0], *sample.targets.images[0])]
    renders = [rgb_picture(image) for image in rendering.rgb[0]]
    near, far = depth_range(rendering.depth)
    depths = [depth_picture(depth, near, far) for depth in rendering.depth[0]]
    for score, photo, render, depth in zip(
        reconstruction.scores, photos, renders, depths, strict=True
    ):
        name = f"{score.frame:05d}_{score.kind.split()[0]}.png"
        write_png(side_by_side([photo, render]), out / "views" / name)
        write_png(depth, out / "depth" / name)
    rows = {"photo": photos, "render": renders, "depth": depths}
    overview = _overview(reconstruction.scores, rows, near, far)
    write_png(overview, out / "overview.png")


def _overview(
    scores: list[ViewScore], rows: dict[str, list[Picture]], near: float, far: float
) -> Picture:
    """At most OVERVIEW_COLUMNS views, the inputs last to be left out."""
    shown = sorted(range(min(len(scores), OVERVIEW_COLUMNS)), key=lambda i: scores[i].frame)
    titles = [
        f"frame {scores[i].frame}, {scores[i].kind.split()[0]}\n{scores[i].psnr:.1f} dB"
        for i in shown
    ]
    chosen = {label: [pictures[i] for i in shown] for label, pictures in rows.items()}
    return figure_picture(grid_figure(chosen, titles, depth_row=("depth", near, far)))


def _write_orbit(model: QueryGaussianModel, reconstruction: Reconstruction, file: Path) -> Cameras:
    path = orbit_path(reconstruction.sample.inputs.cameras, reconstruction.rendering.depth)
    with torch.no_grad():
        frames = model.render(reconstruction.gaussians, path).rgb[0]
    write_gif([rgb_picture(frame) for frame in frames], file, FRAMES_PER_SECOND)
    return path


def orbit_path(
    inputs: Cameras, depths: Tensor, frames: int = ORBIT_FRAMES, side: int = ORBIT_SIDE
) -> Cameras:
    """The loop of `qgs.analysis.reconstruction` about the middle of the rendered depths."""
    near, far = depth_range(depths)
    return finer(orbit(inputs, (near + far) / 2, frames), side)


def _cameras(sample: Sample) -> Cameras:
    a, b = sample.inputs.cameras, sample.targets.cameras
    intrinsics = torch.cat([a.intrinsics, b.intrinsics], 1)
    return Cameras(torch.cat([a.c2w, b.c2w], 1), intrinsics, a.size)


def _camera_record(reconstruction: Reconstruction, path: Cameras) -> dict[str, Any]:
    cameras = _cameras(reconstruction.sample)
    reference, scale = reconstruction.world
    views = [
        {
            "frame": s.frame,
            "kind": s.kind,
            "psnr": round(s.psnr, 3),
            **_plain(cameras[:, [i]]),
        }
        for i, s in enumerate(reconstruction.scores)
    ]
    return {
        "convention": "OpenCV camera-to-world; intrinsics fx, fy, cx, cy in pixels; size H, W",
        "scene": reconstruction.sample.scene,
        "tuning": reconstruction.tuning,
        "to_photos": {
            "rule": "a point p of this world is reference_c2w applied to p / scale in the photos'",
            "reference_c2w": reference.tolist(),
            "scale": float(scale),
        },
        "views": views,
        "orbit": [_plain(path[:, [i]]) for i in range(path.shape[1])],
    }


def _plain(camera: Cameras) -> dict[str, Any]:
    return {
        "c2w": camera.c2w[0, 0].tolist(),
        "intrinsics": camera.intrinsics[0, 0].tolist(),
        "size": list(camera.size),
    }
