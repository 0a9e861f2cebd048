"""How models do on photos of real scenes, over many windows, with the scale that search finds.

    python tools/real_photos.py PHOTOS ... [--model rooms/locus-64] [--windows 12] [--out JSON]

For each window: PSNR and SSIM of novel views with the found scale, with `views.scale: auto`, and by
the best factor of a fine grid; the nearest photo; the scale, and seconds of a core for its search.
Prints Markdown. Windows are those of `choose_windows`, or with --spans those of `qgs eval`, which
have held-out photos in order of the files. Every eighth photo is held out.
"""

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from qgs_viewer.contest import checkpoints, recipes_alike

from qgs.analysis.inputs import choose_windows
from qgs.analysis.scale import ScaleSearch, at_factors, constant_scale
from qgs.cli.options import parse_size
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.domain import Domain
from qgs.data.evaluation import held_out_windows
from qgs.data.samples import Sample, make_sample, own_world
from qgs.io.checkpoint import load
from qgs.metrics.baselines import nearest_input
from qgs.metrics.images import psnr, ssim
from qgs.model import QueryGaussianModel

MODELS = ("rooms/locus-64", "rooms/tokengs-64", "rooms/locus-128")
RATIO, REACH = 1.08, 5.0
"""Of the fine grid: ratio of its factors, how far it goes beyond the range of both scales."""
CHUNK = 12  # factors in one forward pass

Row = dict[str, Any]


def main() -> None:
    options = parsed()
    torch.set_num_threads(options.threads)
    size = parse_size(options.size)
    rows: list[Row] = []
    for name in options.model or MODELS:
        for place in options.photos:
            rows += scene_rows(name, Path(place), options.windows, size, options.spans)
    print(table(rows))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def parsed() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photos", nargs="+", help="folders of photos with cameras")
    parser.add_argument("--model", action="append", help=f"default: {', '.join(MODELS)}")
    parser.add_argument("--windows", type=int, default=12, help="of a scene, at most")
    parser.add_argument("--size", help="HxW of the photos; default: whole, as the models do")
    parser.add_argument("--spans", action="store_true", help="windows in the order of the files")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file of all windows")
    return parser.parse_args()


def scene_rows(
    name: str, photos: Path, count: int, size: tuple[int, int] | None, spans: bool
) -> list[Row]:
    """A row for each window of the scene in the folder `photos`."""
    files = checkpoints([name])
    recipe = next(iter(recipes_alike(files, str(photos), size).values()))
    model = load(next(iter(files.values())), "cpu").eval()
    scene, views = recipe.build_data().scenes("test")[0], recipe.views
    windows = chosen(scene, views, model, count, spans)
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
        at_found, at_auto = judged(model, sample, [factor, auto]).values()
        rows.append(
            {
                "model": name,
                "scene": photos.name,
                "inputs": list(inputs),
                "targets": list(targets),
                "psnr": at_found[0],
                "ssim": at_found[1],
                "auto_psnr": at_auto[0],
                "auto_ssim": at_auto[1],
                "nearest_psnr": float(psnr(copied, sample.targets.images).mean()),
                "nearest_ssim": float(ssim(copied, sample.targets.images).mean()),
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


def chosen(
    scene: Scene, views: ViewsConfig, model: QueryGaussianModel, count: int, spans: bool
) -> Sequence[tuple[Frames, Frames]]:
    """Inputs and targets of at most `count` windows."""
    if not spans:
        return choose_windows(scene, views, model.trained_on or Domain(), count)
    windows = held_out_windows(scene, views)
    step = math.ceil(len(windows) / count)
    return windows[::step]


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
    heads = "| model | scene | windows | PSNR | auto | best | nearest | SSIM | auto | nearest |"
    heads += " scale | loss, mean | worst | s | poor |"
    lines = [heads, "|---|---|" + "--:|" * (heads.count("|") - 3)]
    for model in dict.fromkeys(row["model"] for row in rows):
        own = [row for row in rows if row["model"] == model]
        scenes = list(dict.fromkeys(row["scene"] for row in own))
        for scene in scenes:
            lines.append(line(model, scene, [row for row in own if row["scene"] == scene]))
        if len(scenes) > 1:
            lines.append(line(model, "**all**", own))
    return "\n".join(lines)


def line(model: str, scene: str, rows: Sequence[Row]) -> str:
    """Means over windows, as a row of the table."""

    def mean(key: str) -> float:
        return sum(row[key] for row in rows) / len(rows)

    scales = sorted(row["scale"] for row in rows)
    best = sum(row["psnr"] + row["loss"] for row in rows) / len(rows)
    cells = [
        *(model, scene, str(len(rows))),
        *(f"{value:.2f}" for value in (mean("psnr"), mean("auto_psnr"), best)),
        f"{mean('nearest_psnr'):.2f}",
        *(f"{mean(key):.3f}" for key in ("ssim", "auto_ssim", "nearest_ssim")),
        f"{scales[0]:.2g} to {scales[-1]:.2g}",
        *(f"{value:.2f}" for value in (mean("loss"), max(row["loss"] for row in rows))),
        *(f"{mean('seconds'):.2f}", str(sum(row["poor"] for row in rows))),
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
