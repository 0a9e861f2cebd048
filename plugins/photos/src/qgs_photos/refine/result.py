"""Score an optimised scene on held-out photos, and write its files."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from qgs.data.samples import in_photos_world
from qgs.drawing import images
from qgs.drawing.figures import figure_picture, grid_figure
from qgs.drawing.images import rgb_picture, shaded
from qgs.extensions import INSTALL_ALL
from qgs.files import replacing_entries, write_text
from qgs.geometry.transforms import moved
from qgs.metrics.baselines import nearest_input
from qgs.metrics.images import psnr, ssim
from qgs.reconstruction.scene_formats import (
    load_ply,
    save_gaussians,
    save_ply,
    save_splat,
    writer_of,
)
from qgs.terminal import print_lines
from qgs.types import Gaussians, Views, World
from qgs_photos.refine.adjusting import exposed, fitted_exposure
from qgs_photos.refine.evidence import Evidence, each_view, errors_of
from qgs_photos.refine.metric import Distance
from qgs_photos.refine.refining import RefinedScene
from qgs_photos.refine.scene_photos import ScenePhotos
from qgs_photos.viewing import VIEWER, in_own_world

# Held-out photos in the picture.
_SHOWN = 6
# Views on the page: of photos for the optimisation, and of held-out ones.
_ON_PAGE = 12
_JUDGED_ON_PAGE = 4
# Largest error in pictures, and their colours from 0 to this.
_LARGEST_ERROR = 0.2
_ERROR_MAP = "inferno"
# Equal groups of pixels by the expected error.
_GROUPS = 10


@dataclass(frozen=True)
class Result:
    """An optimised scene with its photos.

    command: command line that makes the scene again. optimised: number of Gaussians that were
    optimised; others, which come before them, are surroundings. world: reference pose (4, 4) and
    scale of the world of the Gaussians, see `own_world`. views: the V photos of the optimisation,
    (1, V). judged: the H held-out photos on which the scene is scored, (1, H). evidence: what the
    photos show of the Gaussians. factor: by which the photos' world is multiplied in files,
    because of the measured distance `scale_by`; 1 without one.
    """

    command: str
    optimised: int
    world: World
    refined: RefinedScene
    photos: ScenePhotos
    views: Views
    judged: Views
    evidence: Evidence
    factor: float
    scale_by: Distance | None

    def in_photos_world(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians (1, G) in the world coordinates of the photos' cameras."""
        reference, scale = self.world
        return moved(gaussians, reference, 1 / float(scale))

    def read_back(self, file: Path) -> "Result":
        """Return a copy of this result with the Gaussians in `file`, so as to score the file."""
        gaussians = in_own_world(self.world, load_ply(file).to(self.views.images.device))
        return replace(self, refined=replace(self.refined, gaussians=gaussians))


@torch.no_grad()
def write_scene(result: Result, out: Path, page: bool, began: float, console: Console) -> None:
    """Write the scene, and print its scores.

    If `out` has the suffix of a scene format, the file `out` gets the Gaussians, in the photos'
    world; .glb also gets the photos' cameras. Otherwise, scene.ply, scene.splat, metrics.json and
    held_out.png are written into the folder `out`, and with `page` index.html. began: time of
    `perf_counter` at the start of the command, for the total time in metrics.json.
    """
    refined = result.refined
    if writer_of(out):
        stored = refined.gaussians
        # readers of PLY files break at properties that they do not know
        if out.suffix.lower() == ".glb":
            stored = replace(stored, features=result.evidence.errors[None, :, None])
        names = map(result.photos.small.frame_name, result.photos.frames)
        cameras = in_photos_world(result.world, refined.cameras, names)
        save_gaussians(result.in_photos_world(stored), out, cameras)
        record = scores(result.read_back(out))
        written = [out]
    else:
        # all files or none: a scene without its scores is none
        with replacing_entries(out, "scene.ply") as fresh:
            record = _write_files(result, fresh, page, began)
            written = sorted(out / entry.name for entry in fresh.iterdir())
    ended = f", ended by {refined.stopped_by}" if refined.stopped_by else ""
    lines = [
        f"{refined.gaussians.count:,} Gaussians after {refined.steps:,} steps in "
        f"{refined.seconds:.0f} s on {len(result.photos.frames)} photos{ended}"
    ]
    if result.factor != 1:
        lines.append(f"lengths are in metres: {result.factor:.4g} times those of the photos' world")
    if mean := record["mean"]:
        lines.append(
            f"{len(record['held_out'])} held-out photos: PSNR {mean['psnr']:.2f} dB, SSIM "
            f"{mean['ssim']:.3f}, alpha {mean['alpha']:.3f}; a copy of the nearest photo: PSNR "
            f"{mean['nearest_input']:.2f} dB; mean error of colours {mean['error']:.3f}, expected "
            f"from the other photos {mean['expected_error'] / record['error_scale']:.3f}"
        )
        if " --adjust exposure" in result.command:
            lines.append(
                "their right halves, with the exposure that fits their left halves: PSNR "
                f"{mean['exposed_psnr']:.2f} dB"
            )
        if mean["psnr"] < mean["nearest_input"]:
            lines.append(
                "the scene is worse than the nearest photo: the poses are wrong, or the time is "
                "too short; run `qgs data check` on the photos"
            )
    print_lines(console, [*lines, *(f"wrote {file}" for file in written)])


def _write_files(result: Result, folder: Path, page: bool, began: float) -> dict[str, Any]:
    """Write the files of `write_scene` into `folder`; return what metrics.json holds."""
    stored = result.in_photos_world(result.refined.gaussians)
    save_ply(stored, folder / "scene.ply")
    # .splat files have no harmonics
    save_splat(stored.replace(sh=None), folder / "scene.splat")
    result = result.read_back(folder / "scene.ply")
    record = scores(result)
    if result.photos.held_out:
        picture = held_out_picture(result, record["held_out"])
        images.write_png(picture, folder / "held_out.png")
    if page:
        write_text(folder / "index.html", page_of(result, record))
    record["total_seconds"] = round(perf_counter() - began, 1)
    write_text(folder / "metrics.json", json.dumps(record, indent=1))
    return record


def page_of(result: Result, record: Mapping[str, Any]) -> str:
    """Return an HTML page of the scene, which opens at the held-out photo with the best score.

    record: what metrics.json holds.
    """
    from qgs_viewer.page import Tour, gaussians_html

    refined = result.refined
    views = replace(result.views, cameras=refined.cameras)
    rows = record["held_out"]
    best = sorted(range(len(rows)), key=lambda row: -rows[row]["psnr"])[:_JUDGED_ON_PAGE]
    every = -(-len(record["refined_on"]) // _ON_PAGE)
    stops = result.judged.select(best).joined(views.select(slice(None, None, every)))
    names = [f"{Path(rows[row]['photo']).name}, held out" for row in best]
    names += [Path(name).name for name in record["refined_on"][::every]]
    note = f"{refined.gaussians.count:,} Gaussians"
    if mean := record["mean"]:
        note += f"; held-out photos: PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.3f}"
    title = Path(result.photos.path).resolve().name
    errors = [error_picture(result.evidence.error_map(stop.cameras)) for stop in each_view(stops)]
    tour = Tour(title, note, stops, names, len(best), refined.cameras, errors)
    return gaussians_html(refined.gaussians, tour)


def scores(result: Result) -> dict[str, Any]:
    """Return what metrics.json holds: command, facts on the optimisation, held-out scores."""
    refined = result.refined
    name_of = result.photos.small.frame_name
    each = list[dict[str, float]]()
    errors = list[Tensor]()
    for photo in each_view(result.judged):
        rendering = VIEWER(result.refined.gaussians, photo.cameras)
        # what no optimisation is needed for
        nearest = nearest_input(result.views, photo.cameras)
        expected = result.evidence.error_map(photo.cameras)
        error = errors_of(rendering.rgb, photo.images)[0, 0]
        errors.append(torch.stack([expected, error]).flatten(1))
        found = {
            "psnr": psnr(rendering.rgb, photo.images),
            "ssim": ssim(rendering.rgb, photo.images),
            "exposed_psnr": exposed_psnr(rendering.rgb, photo.images),
            "error": error,
            "expected_error": expected,
            "alpha": rendering.alpha,
            "nearest_input": psnr(nearest, photo.images),
        }
        each.append({name: float(values.mean()) for name, values in found.items()})
    mean = {name: sum(row[name] for row in each) / len(each) for name in each[0]} if each else {}
    scale = result.evidence.scale
    pairs = groups(torch.cat(errors, 1)) if errors else []
    differences = sum(abs(expected / scale - error) for expected, error in pairs)
    return {
        "command": result.command,
        "gaussians": refined.gaussians.count,
        "steps": refined.steps,
        "seconds": round(refined.seconds, 1),
        "stopped_by": refined.stopped_by,
        "optimised": result.optimised,
        "size": result.views.cameras.size,
        "refined_on": [*map(name_of, result.photos.frames)],
        "camera_centres": result.photos.centres,
        "factor": result.factor,
        "scale_by": result.scale_by,
        "mean": mean,
        "error_scale": scale,
        "expected_and_error": pairs,
        # of errors before that scaling
        "calibration_error": differences / sum(error for _, error in pairs) if pairs else None,
        "held_out": [
            {"frame": frame, "photo": name_of(frame), **row}
            for frame, row in zip(result.photos.held_out, each, strict=True)
        ],
    }


def groups(errors: Tensor) -> list[list[float]]:
    """Return means of pixels in _GROUPS groups of equal size, from the least expected error on.

    errors: expected and true error of P pixels, (2, P). Returns a pair for each group.
    """
    order = errors[0].argsort()
    return [group.mean(1).tolist() for group in errors[:, order].tensor_split(_GROUPS, 1)]


def exposed_psnr(rgb: Tensor, image: Tensor) -> Tensor:
    """Return the PSNR (1, 1) of the right half, with the exposure that fits the left half best.

    rgb, image: render and photo (1, 1, 3, H, W). The exposure is an affine map of colours.
    """
    middle = rgb.shape[-1] // 2
    exposure = fitted_exposure(rgb[..., :middle], image[..., :middle])
    right = exposed(rgb[..., middle:], exposure).clamp(0, 1)
    return psnr(right, image[..., middle:])


def held_out_picture(result: Result, rows: Sequence[Mapping[str, Any]]) -> images.Picture:
    """Draw some held-out photos in a row, and below each the render from its camera.

    rows: scores of the held-out photos.
    """
    every = -(-len(rows) // _SHOWN)
    views = result.judged.select(slice(None, None, every))
    renders = VIEWER(result.refined.gaussians, views.cameras).rgb[0]
    expected = (result.evidence.error_map(view.cameras) for view in each_view(views))
    pictures = {
        "photo": [rgb_picture(image) for image in views.images[0]],
        "render": [rgb_picture(image) for image in renders],
        "error": [*map(error_picture, errors_of(renders, views.images[0]))],
        "expected error": [*map(error_picture, expected)],
    }
    titles = [f"{Path(row['photo']).name}\n{row['psnr']:.2f} dB" for row in rows[::every]]
    return figure_picture(grid_figure(pictures, titles))


def error_picture(errors: Tensor) -> images.Picture:
    """Draw errors of pixels (H, W), bright where they are large."""
    return shaded(errors[None], 0.0, _LARGEST_ERROR, _ERROR_MAP)


def has_viewer(console: Console) -> bool:
    """Return True if the viewer is installed, which makes pages.

    Without the viewer, a line on the console says how to install it.
    """
    try:
        import qgs_viewer.page  # noqa: F401
    except ImportError:
        print_lines(console, [f"no index.html: it needs query-gaussians-viewer: {INSTALL_ALL}"])
        return False
    return True
