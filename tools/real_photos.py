"""Scores of models on real photos, over many windows, at the best scale that a search finds.

    python tools/real_photos.py PHOTOS ... [--model rooms/locus-64 ...]
        [--distances .5 1 2] [--refine 10] [--windows 12] [--out JSON]

A window is a set of neighbouring photos, some as inputs and some as targets. Windows are those that
`qgs demo` chooses for the first model; every eighth photo is a target. PSNR and SSIM of each window
are computed for: the model at the best scale; the model with `views.scale: auto`; the nearest input
photo; this photo as a plane at the depth of the scene; and, with --refine, the model after a
refinement on the inputs. The means are printed as Markdown. --distances: distance between inputs,
relative to the distance in the model's training.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Any

import torch
import torch.nn.functional as F
from kornia.geometry.transform import warp_perspective
from qgs_photos.datasets.view_samplers import apart
from qgs_photos.refine import refine
from qgs_research.studies.tables import markdown_table
from qgs_viewer.comparison import recipes_alike, spread_windows
from torch import Tensor

from qgs.checkpoint.model_file import CheckpointFile
from qgs.data.inputs import scene_depth
from qgs.data.samples import Sample, make_sample, own_world
from qgs.metrics.baselines import nearest_input, pose_distance
from qgs.metrics.images import psnr, ssim
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import at_factor, constant_scale, find_scale
from qgs.types import Cameras, Views

SYSTEMS = ("landmark", "locus", "tokengs")
MODELS = [f"{data}/{system}-64" for data in ("worlds", "rooms") for system in SYSTEMS]

Row = dict[str, Any]


def main() -> None:
    options = parsed()
    torch.set_num_threads(options.threads)
    rows: list[Row] = []
    for given in product(options.model, options.photos, options.distances):
        rows += scene_rows(*given, options)
    print(table(rows))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def parsed() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photos", nargs="+", type=Path, help="folders of photos with camera poses")
    parser.add_argument("--model", nargs="+", default=MODELS, help=f"default: {', '.join(MODELS)}")
    parser.add_argument("--distances", type=float, nargs="+", default=[1.0], metavar="FACTOR")
    parser.add_argument("--refine", type=float, default=0.0, metavar="SECONDS", help="on inputs")
    parser.add_argument("--windows", type=int, default=12, help="largest number per scene")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file for the scores of all windows")
    return parser.parse_args()


def scene_rows(
    name: str, photos: Path, distance: float, options: argparse.Namespace
) -> Iterator[Row]:
    """Yield a row for each window of the scene in the folder `photos`."""
    with CheckpointFile(name) as file:
        recipe = recipes_alike({name: file.recipe}, str(photos), None)[name]
        model = file.model("cpu")
    scene = recipe.build_data().scenes("test")[0]
    views = recipe.views
    # Its weights are not read: only the cameras that it was trained on are asked for.
    with CheckpointFile(options.model[0]) as file:
        domain = apart(file.domain, distance)
    for inputs, targets in spread_windows(scene, views.inputs, domain, options.windows):
        found = find_scale(model, scene, inputs, targets, views).factor
        auto = float(own_world(scene, inputs, views.model_copy(update={"scale": "auto"}))[1])
        sample = make_sample(scene, inputs, targets, constant_scale(views, 1.0), mirror=False)
        shown = {
            "found": rendered(model, sample, found),
            "auto": rendered(model, sample, auto),
            "nearest": nearest_input(sample.inputs, sample.targets.cameras),
            "plane": on_a_plane(sample.inputs, sample.targets.cameras, scene_depth(scene)),
        }
        if options.refine:
            shown["refined"] = rendered(model, sample, found, options.refine)
        row: Row = {"model": name, "scene": photos.name, "distance": distance, "scale": found}
        row |= {"inputs": list(inputs), "targets": list(targets)}
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
    index = pose_distance(inputs.cameras.c2w, targets.c2w)[0].argmin(-1)
    nearest = inputs.select(index.tolist())
    pose_T44 = nearest.cameras.w2c[0] @ targets.c2w[0]
    step_T3 = pose_T44[:, :3, 3]
    # Of the points of a ray, which the nearest camera turns and shifts, the one at this depth.
    plane_T33 = (depth - step_T3[:, 2, None, None]) * torch.eye(3) + F.pad(
        step_T3[..., None], (2, 0)
    )
    onto_T33 = lenses(nearest.cameras) @ plane_T33 @ pose_T44[:, :3, :3] @ lenses(targets).inverse()
    size = targets.size
    return warp_perspective(nearest.images[0], onto_T33.inverse(), size, padding_mode="border")[
        None
    ]


def lenses(cameras: Cameras) -> Tensor:
    """Return intrinsic matrices (V, 3, 3) of cameras (1, V). Pixel centres are integers."""
    k_V33 = torch.diag_embed(F.pad(cameras.intrinsics[0, :, :2], (0, 1), value=1.0))
    k_V33[:, :2, 2] = cameras.intrinsics[0, :, 2:] - 0.5
    return k_V33


def table(rows: Sequence[Row]) -> str:
    """Return a Markdown table of means: a row for each model, scene and distance, and model."""
    scores = [name for name in rows[0] if name.endswith(("PSNR", "SSIM"))]
    groups: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["model"], row["scene"], f"{row['distance']:g}"].append(row)
        # A window may be the best at several distances; it counts once.
        whole = groups[row["model"], "**all**", ""]
        window = (row["scene"], row["inputs"], row["targets"])
        if window not in [(other["scene"], other["inputs"], other["targets"]) for other in whole]:
            whole.append(row)
    lines = [["model", "scene", "distance", "windows", *scores]]
    for names, part in sorted(groups.items()):
        means = [f"{mean(row[score] for row in part):.3f}" for score in scores]
        lines.append([*names, str(len(part)), *means])
    return markdown_table(lines)


if __name__ == "__main__":
    main()
