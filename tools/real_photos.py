"""Scores of models on real photos, over many windows, at the best scale that a search finds.

    python tools/real_photos.py PHOTOS ... [--model rooms/locus-64 --model ...]
        [--distance .5 --distance 1 ...] [--refine 10] [--windows 12] [--out JSON]

A window is a set of neighbouring photos, some as inputs and some as targets. Windows are those that
`qgs demo` chooses for the first model; every eighth photo is a target. PSNR and SSIM of each window
are computed for: the model at the best scale; the model with `views.scale: auto`; the nearest input
photo; this photo as a plane at the depth of the scene; and, with --refine, the model after a
refinement on the inputs. The means are printed as Markdown.
"""

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Any

import torch
import torch.nn.functional as F
import typer
from kornia.geometry.transform import warp_perspective
from qgs_photos.datasets.view_samplers import apart
from qgs_photos.refine import refine
from qgs_research.studies.tables import markdown_table
from qgs_viewer.comparison import recipes_alike, spread_windows
from torch import Tensor

from qgs.checkpoint.model_file import CheckpointFile
from qgs.data.inputs import scene_depth
from qgs.data.samples import Sample, make_sample, own_world
from qgs.domain import Domain
from qgs.metrics.baselines import nearest_input, pose_distance
from qgs.metrics.images import psnr, ssim
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import at_factor, constant_scale, find_scale
from qgs.types import Cameras, Views

SYSTEMS = ("landmark", "locus", "tokengs")
MODELS = [f"{data}/{system}-64" for data in ("worlds", "rooms") for system in SYSTEMS]
DISTANCES = [1.0]

Row = dict[str, Any]


def main(
    photos: list[Path],
    model: list[str] = MODELS,
    distance: list[float] = DISTANCES,
    refine: float = 0.0,
    windows: int = 12,
    threads: int = 1,
    out: Path | None = None,
) -> None:
    """Print scores of models on PHOTOS, folders of photos with camera poses.

    --distance: distance between inputs, relative to that in the model's training. --refine: seconds
    of a refinement on the inputs, 0 for none. --windows: largest number for each scene. --out: JSON
    file for the scores of all windows.
    """
    torch.set_num_threads(threads)
    rows: list[Row] = []
    # Its weights are not read: only the cameras that it was trained on are asked for.
    with CheckpointFile(model[0]) as file:
        domain = file.domain
    for name, folder, factor in product(model, photos, distance):
        for row in scene_rows(name, folder, apart(domain, factor), windows, refine):
            rows.append({**row, "distance": factor})
    print(table(rows))
    if out:
        out.write_text(json.dumps(rows, indent=1))


def scene_rows(
    name: str, photos: Path, domain: Domain, windows: int, seconds: float
) -> Iterator[Row]:
    """Yield a row for each window of the scene in the folder `photos`."""
    with CheckpointFile(name) as file:
        recipe = recipes_alike({name: file.recipe}, str(photos), None)[name]
        model = file.model("cpu")
    scene = recipe.build_data().scenes("test")[0]
    views = recipe.views
    for inputs, targets in spread_windows(scene, views.inputs, domain, windows):
        found = find_scale(model, scene, inputs, targets, views).factor
        auto = float(own_world(scene, inputs, views.model_copy(update={"scale": "auto"}))[1])
        sample = make_sample(scene, inputs, targets, constant_scale(views, 1.0))
        shown = {
            "found": rendered(model, sample, found),
            "auto": rendered(model, sample, auto),
            "nearest": nearest_input(sample.inputs, sample.targets.cameras),
            "plane": on_a_plane(sample.inputs, sample.targets.cameras, scene_depth(scene)),
        }
        if seconds:
            shown["refined"] = rendered(model, sample, found, seconds)
        row: Row = {"model": name, "scene": photos.name, "scale": found}
        row |= {"inputs": inputs, "targets": targets}
        for kind, images in shown.items():
            row[f"{kind} PSNR"] = float(psnr(images, sample.targets.images).mean())
            row[f"{kind} SSIM"] = float(ssim(images, sample.targets.images).mean())
        yield row


def rendered(
    model: QueryGaussianModel, sample: Sample, factor: float, seconds: float = 0.0
) -> Tensor:
    """Render the target views of `sample`, (1, T, 3, H, W).

    factor: scale of camera positions. seconds: time for a refinement on the inputs, 0 for none.
    """
    inputs = at_factor(sample.inputs, factor)
    cameras = at_factor(sample.targets, factor).cameras
    with torch.no_grad():
        gaussians = model.forward(inputs).gaussians
    if seconds:
        gaussians = refine(gaussians, inputs, seconds, renderer=model.renderer).gaussians
    with torch.no_grad():
        return model.render(gaussians, cameras).rgb


def on_a_plane(inputs: Views, targets: Cameras, depth: float) -> Tensor:
    """Return for each target the nearest input, warped as a plane at `depth`, (1, T, 3, H, W)."""
    views = inputs.select(pose_distance(inputs.cameras.c2w, targets.c2w)[0].argmin(-1).tolist())
    nearest = views.cameras
    pose_T44 = targets.w2c[0] @ nearest.c2w[0]
    # Of a point at this depth, z / depth is 1: it adds the shift to the turned point.
    plane_T33 = pose_T44[:, :3, :3] + F.pad(pose_T44[:, :3, 3:] / depth, (2, 0))
    onto_T33 = lenses(targets) @ plane_T33 @ lenses(nearest).inverse()
    return warp_perspective(views.images[0], onto_T33, targets.size, padding_mode="border")[None]


def lenses(cameras: Cameras) -> Tensor:
    """Return intrinsic matrices (V, 3, 3) of cameras (1, V). Pixel centres are integers."""
    k_V33 = torch.diag_embed(F.pad(cameras.intrinsics[0, :, :2], (0, 1), value=1.0))
    k_V33[:, :2, 2] = cameras.intrinsics[0, :, 2:] - 0.5
    return k_V33


def table(rows: Sequence[Row]) -> str:
    """Return a Markdown table of means: a row for each model, scene and distance, and model."""
    scores = [name for name in rows[0] if name.endswith(("PSNR", "SSIM"))]
    groups = defaultdict[tuple[str, str, str], dict[str, Row]](dict)
    for row in rows:
        window = f"{row['scene']} {row['inputs']} {row['targets']}"
        # A window may be the best at several distances; of all, it counts once.
        for names in ((row["scene"], f"{row['distance']:g}"), ("**all**", "")):
            groups[row["model"], *names].setdefault(window, row)
    lines = [["model", "scene", "distance", "windows", *scores]]
    for names, part in sorted(groups.items()):
        means = [f"{mean(row[score] for row in part.values()):.3f}" for score in scores]
        lines.append([*names, str(len(part)), *means])
    return markdown_table(lines)


if __name__ == "__main__":
    typer.run(main)
