"""Reconstruction of one scene: which frames, a camera path, scores, and the files written."""

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qgs.contracts import Scene, ViewsConfig
from qgs.data.domain import Domain, verdict
from qgs.data.images import framing
from qgs.data.sampling import (
    Sample,
    make_sample,
    moments,
    own_world,
    spread,
)
from qgs.drawing.figures import figure_picture, grid_figure
from qgs.drawing.images import (
    Picture,
    depth_picture,
    depth_range,
    finer,
    png_bytes,
    rgb_picture,
    side_by_side,
    write_gif,
    write_png,
)
from qgs.geometry.poses import look_at, relative_to, scaled
from qgs.geometry.transforms import moved
from qgs.io.files import replacing_entries, write_text
from qgs.io.ply import save_ply
from qgs.memory import refuse_beyond_memory
from qgs.metrics.baselines import BASELINES, worse_than_nearest
from qgs.metrics.images import Psnr, psnr
from qgs.metrics.scales import capped_share, too_many_capped
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Gaussians, Prediction, Rendering
from qgs.wording import listed, numbered

ORBIT_FRAMES = 48
ORBIT_SIDE = 320
FRAMES_PER_SECOND = 16
OVERVIEW_COLUMNS = 8
NOVEL, SWAY = 6, 0.12

_PIXEL_BYTES = 5 * 4
"""Of a rendering: RGB, alpha and depth in float32."""

KINDS = ("input", "novel", "seen in training")
"""A compared view of a folder that the model was trained on is novel if it was held out."""


def choose_frames(
    total: int,
    inputs: int,
    span: int,
    frames: Sequence[int] | None = None,
    compare: Sequence[int] | None = None,
    held_out: Sequence[int] = (),
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Input frames and novel frames, from 0 to total - 1.

    frames: the inputs; None spreads `inputs` of them, ends included, over the middle `span` frames.
    compare: the novel ones; None spreads at most NOVEL between the inputs. held_out: frames that
    training left out; inputs are then chosen from the others, and these are compared.
    Raises ValueError for frames that do not exist, come twice, or are both input and novel.
    """
    usable = [frame for frame in range(total) if frame not in held_out]
    if frames is None:
        if inputs > len(usable):
            raise ValueError(
                f"{inputs} input views were asked for, but there are {len(usable)} photos"
            )
        span = min(max(span, inputs), len(usable))
        first = (len(usable) - span) // 2
        frames = _evenly(usable[first : first + span], inputs)
    _refuse_missing(frames, total)
    if compare is None:
        between = [f for f in range(min(frames), max(frames) + 1) if f not in frames]
        between = [f for f in between if f in held_out] or between
        compare = _evenly(between, min(NOVEL, len(between)))
    _refuse_missing(compare, total)
    every = [*frames, *compare]
    twice = sorted({frame for frame in every if every.count(frame) > 1})
    if twice:
        raise ValueError(
            f"frames named twice: {listed(twice)}; inputs and compared frames must differ"
        )
    return tuple(frames), tuple(compare)


def _refuse_missing(frames: Sequence[int], total: int) -> None:
    missing = [frame for frame in frames if not 0 <= frame < total]
    if missing:
        raise ValueError(f"frames {listed(missing)} do not exist; the photos are 0..{total - 1}")


def choose_sample(
    scene: Scene,
    views: ViewsConfig,
    inputs: int | None,
    frames: Sequence[int] | None,
    compare: Sequence[int] | None,
) -> tuple[Sample, tuple[Tensor, Tensor]]:
    """The views of `scene` that `choose_frames` picks, and their world as of `own_world`.

    Where times are known, inputs spread over them, and views compared by default are of one.
    """
    wanted, span = inputs or views.inputs, views.gap[1] + 1
    usable = moments(scene)
    if scene.times is not None and frames is None and wanted <= len(usable):
        first = max(len(usable) - max(span, wanted), 0) // 2
        frames = spread(usable[first : len(usable) - first], wanted)
    picked = choose_frames(len(scene), wanted, span, frames, compare, held_out=scene.held_out)
    if scene.times is not None and compare is None and picked[1]:
        asked = scene.times[picked[1][len(picked[1]) // 2]]
        picked = picked[0], tuple(frame for frame in picked[1] if scene.times[frame] == asked)
    (height, width), shown = scene.cameras.size, len(picked[0]) + len(picked[1])
    finer_by = max(1, round(ORBIT_SIDE / max(height, width))) ** 2
    refuse_beyond_memory(
        f"a reconstruction of {shown} photos of {height} x {width}",
        {
            "photos and their renderings": shown * _PIXEL_BYTES * 2 * height * width,
            f"the orbit's {ORBIT_FRAMES} renderings": (
                ORBIT_FRAMES * _PIXEL_BYTES * height * width * finer_by
            ),
        },
        "Take smaller photos (--size) or fewer of them (--inputs, --frames, --holdout).",
    )
    sample = make_sample(scene, *picked, views, mirror=False)
    return sample, own_world(scene, picked[0], views)


def _evenly(frames: Sequence[int], count: int) -> tuple[int, ...]:
    """`count` of `frames`, the first and the last among them; one alone is the middle one."""
    last = len(frames) - 1
    places = np.linspace(0, last, count).round() if count > 1 else np.full(count, last // 2)
    return tuple(frames[int(place)] for place in places)


def orbit_path(
    inputs: Cameras, depths: Tensor, frames: int = ORBIT_FRAMES, side: int = ORBIT_SIDE
) -> Cameras:
    """`orbit` about the middle of the rendered `depths`, at least `side` pixels large."""
    near, far = depth_range(depths)
    return finer(orbit(inputs, (near + far) / 2, frames), side)


def orbit(inputs: Cameras, depth: float, frames: int) -> Cameras:
    """A loop (1, frames) past the input cameras (1, V), swaying by SWAY times `depth`."""
    angles = torch.arange(frames, device=inputs.c2w.device) * (2 * math.pi / frames)
    count = inputs.shape[1]
    # From 0, the first input, to count - 1, the last, and back.
    times_T = (1 - angles.cos()) / 2 * (count - 1)
    distances_TV = times_T[:, None] - torch.arange(count, device=times_T.device)
    weights_TV = torch.softmax(-0.5 * (distances_TV / 0.6) ** 2, -1)
    mean = torch.einsum("tv,vij->tij", weights_TV, inputs.c2w[0])
    _, down, forward, centre = mean[:, :3].unbind(-1)
    right, down, forward, centre = look_at(centre, forward, down)[:, :3].unbind(-1)
    reach = SWAY * depth
    eye = centre + reach * angles.sin()[:, None] * right
    eye = eye - reach / 2 * angles.cos()[:, None] * down
    c2w = look_at(eye, centre + depth * forward - eye, down)
    return Cameras(c2w[None], inputs.intrinsics[:, :1].expand(1, frames, 4), inputs.size)


@dataclass(frozen=True)
class ViewScore:
    """A rendered view against its photo, of one of KINDS; PSNR in dB. baselines: not of inputs."""

    frame: int
    kind: str
    psnr: float
    baselines: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Reconstruction:
    """Gaussians (1, G) of a sample by `model`, in its world, and what its cameras see of them.

    prediction: None where the Gaussians were tuned or refined. world: reference pose (4, 4) and
    scale, as of `own_world`. tuning: of tokens, refinement: of Gaussians; None without. remarks:
    sentences on the photos and what came of them.
    """

    model: QueryGaussianModel
    sample: Sample
    prediction: Prediction | None
    gaussians: Gaussians
    rendering: Rendering
    scores: list[ViewScore]
    world: tuple[Tensor, Tensor]
    tuning: Mapping[str, Any] | None = None
    refinement: Mapping[str, Any] | None = None
    remarks: Sequence[str] = ()

    @property
    def worse_than_nearest(self) -> str:
        """As `qgs.metrics.baselines`, on the compared views."""
        rows = [(s.psnr, s.baselines["nearest_input"]) for s in self.scores if s.baselines]
        if not rows:
            return ""
        model, nearest = (sum(values) / len(rows) for values in zip(*rows, strict=True))
        advice = {"what": f"the {'tuned' if self.tuning else 'feed-forward'} result"}
        if self.refinement:
            advice = {"what": "the refined result", "or_else": "refine longer, or on more photos"}
        return worse_than_nearest(Psnr.column, model, nearest, **advice)

    @property
    def in_photos_world(self) -> Gaussians:
        """The Gaussians (1, G) in the frame and unit of the photos' cameras, as for `save_ply`."""
        reference, scale = self.world
        return moved(self.gaussians, reference, 1 / float(scale))

    def render(self, cameras: Cameras) -> Rendering:
        """What cameras (1, V) in the photos' world see, depth in its unit too."""
        reference, scale = (part.to(cameras.c2w.device) for part in self.world)
        c2w = scaled(relative_to(reference, cameras.c2w.double()), scale).float()
        own = Cameras(c2w, cameras.intrinsics.float(), cameras.size).to(self.gaussians.means.device)
        with torch.no_grad():
            seen = self.model.render(self.gaussians, own)
        return replace(seen, depth=seen.depth / float(scale))

    def save(self, folder: str | PathLike[str]) -> list[Path]:
        """Write what `qgs reconstruct` writes; see `write_reconstruction`."""
        return write_reconstruction(self.model, self, Path(folder))

    def __repr__(self) -> str:
        """Scene, views with PSNR, and the remarks."""
        views = [f"{s.kind} {self.sample.label(s.frame)} {s.psnr:.2f} dB" for s in self.scores]
        heading = f"Reconstruction of {self.sample.scene}: {self.gaussians.count:,} Gaussians"
        return "\n  ".join([heading, *views, *self.remarks])

    def _repr_png_(self) -> bytes:
        return png_bytes(overview(self, dpi=72))


@torch.no_grad()
def reconstruct(
    model: QueryGaussianModel,
    sample: Sample,
    world: tuple[Tensor, Tensor],
    seen: Collection[int] = (),
    tuned: Gaussians | None = None,
    tuning: Mapping[str, Any] | None = None,
    refinement: Mapping[str, Any] | None = None,
) -> Reconstruction:
    """Gaussians of `sample`, rendered from its views, on the model's device.

    seen: in training. tuned: given Gaussians, by the tuning or the refinement that is recorded.
    """
    device = next(model.parameters()).device
    sample = replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
    prediction: Prediction | None = model(sample.inputs) if tuned is None else None
    gaussians = tuned if prediction is None else prediction.gaussians
    assert gaussians is not None
    rendering = model.render(gaussians, _cameras(sample))
    truth = sample.targets.images
    photos = torch.cat([sample.inputs.images, truth], 1)
    quality = psnr(rendering.rgb[0], photos[0]).tolist()
    baselines = {
        name: psnr(baseline(sample.inputs, sample.targets.cameras), truth)[0].tolist()
        for name, baseline in BASELINES.items()
    }
    inputs = zip(sample.input_frames, quality, strict=False)
    scores = [ViewScore(frame, "input", value) for frame, value in inputs]
    for index, frame in enumerate(sample.target_frames):
        kind = "seen in training" if frame in seen else "novel"
        others = {name: values[index] for name, values in baselines.items()}
        value = quality[len(sample.input_frames) + index]
        scores.append(ViewScore(frame, kind, value, others))
    return Reconstruction(
        model, sample, prediction, gaussians, rendering, scores, world, tuning, refinement
    )


def remarks_on(
    result: Reconstruction, scene: Scene, model: QueryGaussianModel, views: ViewsConfig
) -> list[str]:
    """What is to be said of what `model` predicts for photos of `scene`."""
    sample, found = result.sample, Domain()
    found.see(sample.inputs.cameras, sample.targets.cameras)
    said = (
        verdict(model.trained_on or Domain(), found),
        framing(scene, sample.input_frames[0]),
        too_many_capped(model.head, capped_share(model.head, result.gaussians), views),
        result.worse_than_nearest,
    )
    return [*filter(None, said)]


def _cameras(sample: Sample) -> Cameras:
    a, b = sample.inputs.cameras, sample.targets.cameras
    intrinsics = torch.cat([a.intrinsics, b.intrinsics], 1)
    return Cameras(torch.cat([a.c2w, b.c2w], 1), intrinsics, a.size)


def write_reconstruction(
    model: QueryGaussianModel, reconstruction: Reconstruction, out: Path
) -> list[Path]:
    """Write gaussians.ply, overview.png, views/, depth/, orbit.gif and cameras.json into `out`.

    All is in the model's normalised world; cameras.json tells how it lies in that of the photos.
    Earlier files and folders of these names are replaced, all at the end.
    """
    path = orbit_path(reconstruction.sample.inputs.cameras, reconstruction.rendering.depth)
    with torch.no_grad():
        frames = model.render(reconstruction.gaussians, path).rgb[0]
    with replacing_entries(out) as fresh:
        save_ply(reconstruction.gaussians, fresh / "gaussians.ply")
        _write_views(reconstruction, fresh)
        write_gif([rgb_picture(f) for f in frames], fresh / "orbit.gif", FRAMES_PER_SECOND)
        record = json.dumps(_camera_record(reconstruction, path), indent=1)
        write_text(fresh / "cameras.json", record)
        names = sorted(entry.name for entry in fresh.iterdir())
    return [out / name for name in names]


def _write_views(reconstruction: Reconstruction, out: Path) -> None:
    """Every view as a file, and the overview."""
    rows = _pictures(reconstruction)
    for i, score in enumerate(reconstruction.scores):
        name = f"{score.frame:05d}_{score.kind.split()[0]}.png"
        write_png(side_by_side([rows["photo"][i], rows["render"][i]]), out / "views" / name)
        write_png(rows["depth"][i], out / "depth" / name)
    write_png(overview(reconstruction), out / "overview.png")


def _pictures(reconstruction: Reconstruction) -> dict[str, list[Picture]]:
    """Photo, render and depth of every view."""
    sample, rendering = reconstruction.sample, reconstruction.rendering
    near, far = depth_range(rendering.depth)
    return {
        "photo": [rgb_picture(i) for i in (*sample.inputs.images[0], *sample.targets.images[0])],
        "render": [rgb_picture(image) for image in rendering.rgb[0]],
        "depth": [depth_picture(depth, near, far) for depth in rendering.depth[0]],
    }


def overview(reconstruction: Reconstruction, dpi: int = 120) -> Picture:
    """Photos over renders and depth, of at most OVERVIEW_COLUMNS views: inputs stay longest."""
    sample, scores, rows = reconstruction.sample, reconstruction.scores, _pictures(reconstruction)
    shown = sorted(range(min(len(scores), OVERVIEW_COLUMNS)), key=lambda i: scores[i].frame)
    quality = [f"{Psnr.column.shown(score.psnr)} {Psnr.column.unit}" for score in scores]
    files = [Path(sample.names.get(s.frame, "")).name for s in scores]
    titles = [
        f"frame {numbered(scores[i].frame, files[i])}\n{scores[i].kind.split()[0]}, {quality[i]}"
        for i in shown
    ]
    chosen = {label: [pictures[i] for i in shown] for label, pictures in rows.items()}
    scale = depth_range(reconstruction.rendering.depth)
    return figure_picture(grid_figure(chosen, titles, depth_row=("depth", *scale)), dpi)


def _camera_record(reconstruction: Reconstruction, path: Cameras) -> dict[str, Any]:
    reference, scale = reconstruction.world
    names = reconstruction.sample.names
    cameras = _plain(_cameras(reconstruction.sample))
    return {
        "convention": "OpenCV camera-to-world; intrinsics fx, fy, cx, cy in pixels; size H, W",
        "scene": reconstruction.sample.scene,
        "model": reconstruction.model.loaded_from,
        "tuning": reconstruction.tuning,
        "remarks": list(reconstruction.remarks),
        "refinement": reconstruction.refinement,
        "background": reconstruction.model.renderer.config.background,
        "to_photos": {
            "rule": "a point p of this world is reference_c2w applied to p / scale in the photos'",
            "reference_c2w": reference.tolist(),
            "scale": float(scale),
        },
        "views": [
            {"frame": s.frame, "photo": names.get(s.frame), "kind": s.kind}
            | {"psnr": round(s.psnr, 3), **camera}
            for s, camera in zip(reconstruction.scores, cameras, strict=True)
        ],
        "orbit": _plain(path),
    }


def _plain(cameras: Cameras) -> list[dict[str, Any]]:
    c2w, intrinsics = cameras.c2w[0].tolist(), cameras.intrinsics[0].tolist()
    return [
        {"c2w": pose, "intrinsics": lens, "size": list(cameras.size)}
        for pose, lens in zip(c2w, intrinsics, strict=True)
    ]
