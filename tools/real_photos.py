"""How models do on photos of real scenes, over many windows, with the scale that search finds.

    python tools/real_photos.py PHOTOS ... [--model rooms/locus-64] [--like MODEL]
        [--distances .5 1 2] [--refine 10] [--windows 12] [--out JSON]

For each window: PSNR and SSIM of novel views with the found scale, with `views.scale: auto`, and by
the best factor of a fine grid; the nearest photo, as it is and as a plane at the depth at which the
inputs agree best; after a refinement on the inputs; the scale, and seconds of a core for its
search. Prints Markdown. Windows are those that `qgs demo` chooses for the model --like, the first
one by default, or with --spans those of `qgs eval`, which have held-out photos in order of the
files. Every eighth photo is held out. --distances: how far inputs are apart, in distances of the
training of --like.
"""

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from qgs_photos.datasets.overlapping import apart
from qgs_photos.refine import refine
from qgs_viewer.comparison import checkpoints, recipes_alike

from qgs.checkpoint.model_file import CheckpointFile, load
from qgs.cli.options import parse_size
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.depth import scene_depth
from qgs.data.inputs import choose_windows
from qgs.data.samples import Sample, make_sample, own_world
from qgs.domain import Domain
from qgs.evaluate.plan import held_out_windows
from qgs.geometry.rays import pixel_directions
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.metrics.baselines import nearest_input
from qgs.metrics.images import psnr, ssim
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import ScaleSearch, at_factors, constant_scale
from qgs.types import Cameras, Views

SYSTEMS = ("landmark", "locus", "tokengs")
MODELS = [f"{data}/{system}-64" for data in ("worlds", "rooms") for system in SYSTEMS]
RATIO, REACH = 1.08, 5.0
"""Of the fine grid: ratio of its factors, how far it goes beyond the range of both scales."""
CHUNK = 12  # factors in one forward pass
PLANES = 48  # depths that are tried, from a tenth to ten times that of the scene

Row = dict[str, Any]


def main() -> None:
    options = parsed()
    torch.set_num_threads(options.threads)
    size = parse_size(options.size)
    rows: list[Row] = []
    for name in options.model or MODELS:
        for place in options.photos:
            for distance in options.distances:
                rows += scene_rows(name, Path(place), distance, size, options)
    print(table(rows))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def parsed() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photos", nargs="+", help="folders of photos with cameras")
    parser.add_argument("--model", action="append", help=f"default: {', '.join(MODELS)}")
    parser.add_argument("--like", metavar="MODEL", help="that has the windows; default: the first")
    parser.add_argument("--distances", type=float, nargs="+", default=[1.0], metavar="FACTOR")
    parser.add_argument("--refine", type=float, default=0.0, metavar="SECONDS", help="on inputs")
    parser.add_argument("--windows", type=int, default=12, help="of a scene, at most")
    parser.add_argument("--size", help="HxW of the photos; default: whole, as the models do")
    parser.add_argument("--spans", action="store_true", help="windows in the order of the files")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file of all windows")
    return parser.parse_args()


def scene_rows(
    name: str,
    photos: Path,
    distance: float,
    size: tuple[int, int] | None,
    options: argparse.Namespace,
) -> list[Row]:
    """A row for each window of the scene in the folder `photos`."""
    files = checkpoints([name])
    recipe = next(iter(recipes_alike(files, str(photos), size).values()))
    model = load(next(iter(files.values())), "cpu").eval()
    scene, views = recipe.build_data().scenes("test")[0], recipe.views
    domain = trained_on(options.like or (options.model or MODELS)[0])
    windows = chosen(scene, views, apart(domain, distance), options.windows, options.spans)
    search, rows = ScaleSearch(model, views.model_copy(update={"scale": "search"})), list[Row]()
    for inputs, targets in windows:
        began = time.process_time()
        factor = search(scene, inputs, targets).scale_factor
        seconds = time.process_time() - began
        found = search.found[scene.name, inputs, targets]
        auto = float(own_world(scene, inputs, views.model_copy(update={"scale": "auto"}))[1])
        sample = make_sample(scene, inputs, targets, constant_scale(views, 1.0), mirror=False)
        grid = judged(model, sample, fine_grid(factor, auto))
        best = max(grid, key=lambda scale: grid[scale][0])
        copied = nearest_input(sample.inputs, sample.targets.cameras)
        depth = agreeing_depth(sample.inputs, scene_depth(scene))
        plane = warped_by_plane(sample.inputs, sample.targets.cameras, depth)
        at_found, at_auto = judged(model, sample, [factor, auto]).values()
        rows.append(
            {
                "model": name,
                "scene": photos.name,
                "distance": distance,
                "inputs": list(inputs),
                "targets": list(targets),
                "psnr": at_found[0],
                "ssim": at_found[1],
                "auto_psnr": at_auto[0],
                "auto_ssim": at_auto[1],
                "nearest_psnr": float(psnr(copied, sample.targets.images).mean()),
                "nearest_ssim": float(ssim(copied, sample.targets.images).mean()),
                "plane_psnr": float(psnr(plane, sample.targets.images).mean()),
                "plane_ssim": float(ssim(plane, sample.targets.images).mean()),
                "refined_psnr": refined(model, sample, factor, options.refine),
                "scale": factor,
                "auto": auto,
                "best": best,
                "loss": max(grid[best][0] - at_found[0], 0.0),
                "seconds": seconds,
                "further": list(found.further),
                "search_psnr": found.psnr,
                "poor": bool(found.poor),
            }
        )
    return rows


@cache
def trained_on(name: str) -> Domain:
    """The cameras that a model was trained on; its weights are not read."""
    with CheckpointFile(name) as file:
        return file.domain


def chosen(
    scene: Scene, views: ViewsConfig, domain: Domain, count: int, spans: bool
) -> Sequence[tuple[Frames, Frames]]:
    """Inputs and targets of at most `count` windows."""
    if not spans:
        return choose_windows(scene, views, domain, count)
    windows = held_out_windows(scene, views)
    step = math.ceil(len(windows) / count)
    return windows[::step]


def warped_by_plane(inputs: Views, targets: Cameras, depth: float) -> torch.Tensor:
    """`nearest_input` (1, T, 3, H, W) as seen from the targets, were all it shows at `depth`."""
    numbers = torch.arange(inputs.images.shape[1]).float().view(1, -1, 1, 1, 1)
    by_number = Views(numbers.expand_as(inputs.images), inputs.cameras)
    nearest = nearest_input(by_number, targets)[0, :, 0, 0, 0].int().tolist()
    warped = list[torch.Tensor]()
    for target, frame in enumerate(nearest):
        c2w, source = targets.c2w[0, target], inputs.cameras.c2w[0, frame]
        directions = pixel_directions(targets.intrinsics[0, target], targets.size) @ c2w[:3, :3].T
        ahead, origin = source[:3, 2], c2w[:3, 3]
        steps = (depth - ahead @ (origin - source[:3, 3])) / (directions @ ahead).clamp_min(1e-6)
        points = (origin + steps[..., None] * directions).view(1, -1, 3)
        local = to_camera(points, inputs.cameras[:, [frame]])[0, 0]
        pixels = to_pixels(local, inputs.cameras.intrinsics[0, frame])
        height, width = inputs.cameras.size
        grid = 2 * pixels.view(1, *targets.size, 2) / torch.tensor([width, height]) - 1
        photo = inputs.images[:, frame]
        warped.append(F.grid_sample(photo, grid, padding_mode="border", align_corners=False))
    return torch.stack(warped, 1)


def agreeing_depth(inputs: Views, depth: float) -> float:
    """The depth of a plane at which each input, seen from the next one, is most like it."""
    views = [inputs.select(slice(index, index + 1)) for index in range(inputs.images.shape[1])]

    def off(at: float) -> float:
        pairs = zip(views, views[1:] + views[:1], strict=True)
        return sum(
            float((warped_by_plane(one, two.cameras, at) - two.images).square().mean())
            for one, two in pairs
        )

    return min((depth * 10 ** (2 * k / (PLANES - 1) - 1) for k in range(PLANES)), key=off)


def refined(model: QueryGaussianModel, sample: Sample, factor: float, seconds: float) -> float:
    """PSNR of the targets after a refinement on the inputs; NaN without one."""
    if not seconds:
        return math.nan
    scale = torch.tensor([factor])
    inputs, targets = at_factors(sample.inputs, scale), at_factors(sample.targets, scale)
    with torch.no_grad():
        found = model.forward(inputs).gaussians
    found = refine(found, inputs, seconds, renderer=model.renderer).gaussians
    with torch.no_grad():
        seen = model.render(found, targets.cameras).rgb
    return float(psnr(seen, targets.images).mean())


def fine_grid(*factors: float) -> list[float]:
    """Factors RATIO apart around all of `factors`."""
    low, high = min(factors) / REACH, max(factors) * REACH
    steps = math.ceil(math.log(high / low) / math.log(RATIO))
    return [low * RATIO**step for step in range(steps + 1)]


@torch.no_grad()
def judged(
    model: QueryGaussianModel, sample: Sample, factors: Sequence[float]
) -> Mapping[float, tuple[float, float]]:
    """Mean PSNR and SSIM of the targets of `sample`, whose factor is 1, at each factor."""
    found = dict[float, tuple[float, float]]()
    for start in range(0, len(factors), CHUNK):
        part = factors[start : start + CHUNK]
        scales = torch.tensor(part)
        gaussians = model.forward(at_factors(sample.inputs, scales)).gaussians
        targets = at_factors(sample.targets, scales)
        seen = model.render(gaussians, targets.cameras).rgb
        scores = (measure(seen, targets.images).mean(1).tolist() for measure in (psnr, ssim))
        found.update(zip(part, zip(*scores, strict=True), strict=True))
    return found


def table(rows: Sequence[Row]) -> str:
    """A line for each model and scene, with means and worst losses, and one for each model."""
    heads = (
        "| model | scene | distance | windows | PSNR | auto | best | refined | nearest | plane |"
    )
    heads += " SSIM | auto | nearest | plane | scale | loss, mean | worst | s | poor |"
    lines = [heads, "|---|---|" + "--:|" * (heads.count("|") - 3)]
    for model in dict.fromkeys(row["model"] for row in rows):
        own = [row for row in rows if row["model"] == model]
        of = dict[tuple[float, str], list[Row]]()
        for row in own:
            of.setdefault((row["distance"], row["scene"]), []).append(row)
        lines += [line(model, scene, part) for (_, scene), part in of.items()]
        if len(of) > 1:
            # A window may be the best at several distances.
            found = {(row["scene"], f"{row['inputs']} {row['targets']}"): row for row in own}
            lines.append(line(model, "**all**", [*found.values()]))
    return "\n".join(lines)


def line(model: str, scene: str, rows: Sequence[Row]) -> str:
    """Means over windows, as a row of the table."""

    def mean(key: str) -> float:
        return sum(row[key] for row in rows) / len(rows)

    scales = sorted(row["scale"] for row in rows)
    best = sum(row["psnr"] + row["loss"] for row in rows) / len(rows)
    cells = [
        *(model, scene, "/".join(f"{d:g}" for d in sorted({row["distance"] for row in rows}))),
        str(len(rows)),
        *(f"{value:.2f}" for value in (mean("psnr"), mean("auto_psnr"), best)),
        *(f"{mean(key):.2f}" for key in ("refined_psnr", "nearest_psnr", "plane_psnr")),
        *(f"{mean(key):.3f}" for key in ("ssim", "auto_ssim", "nearest_ssim", "plane_ssim")),
        f"{scales[0]:.2g} to {scales[-1]:.2g}",
        *(f"{value:.2f}" for value in (mean("loss"), max(row["loss"] for row in rows))),
        *(f"{mean('seconds'):.2f}", str(sum(row["poor"] for row in rows))),
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
