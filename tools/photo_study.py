"""The models of a study on photos that none was trained on: a row for each variant, with intervals.

    python tools/photo_study.py STUDY PHOTOS ... [--like worlds/landmark-64] [--distances .5 1 2]

STUDY: what `qgs study` wrote. Windows are those that `qgs demo` chooses for the model --like, and
inputs as far apart as tools/real_photos.py says; the same for all. Every model's scale is searched.
Prints Markdown: novel views of each scene, and over all windows the difference to the variant
before, with its 95 % interval over trainings and windows.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from qgs_studies.intervals import interval
from qgs_viewer.contest import checkpoints, recipes_alike
from real_photos import apart, chosen, judged, trained_on

from qgs.analysis.scale import ScaleSearch, constant_scale
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.samples import Sample, make_sample
from qgs.io.checkpoint import load
from qgs.io.files import write_text
from qgs.metrics.baselines import nearest_input
from qgs.metrics.images import psnr, ssim
from qgs.model import QueryGaussianModel


class Case(NamedTuple):
    """A window of a scene. sample: its photos, with the scene's own lengths."""

    scene: Scene
    views: ViewsConfig
    inputs: Frames
    targets: Frames
    sample: Sample


def main() -> None:
    options = parsed()
    torch.set_num_threads(options.threads)
    cases = list(windows(options))
    trained = sorted(options.study.glob("runs/*/seed-*/evaluation/protocol.json"))
    if not trained:
        raise SystemExit(f"{options.study} has no trained runs: qgs study makes them")
    scores: dict[str, list[list[float]]] = {}  # by "VARIANT/seed-N", of each case PSNR and SSIM
    scores["nearest/"] = [copied(case) for case in cases]
    for run in (file.parents[1] for file in trained):
        model = load(run, "cpu").eval()
        scores["/".join(run.parts[-2:])] = [score(model, case) for case in cases]
    if options.out:
        names = [[case.scene.name, case.inputs, case.targets] for case in cases]
        write_text(options.out, json.dumps({"windows": names, "scores": scores}, indent=1))
    print(table(scores, [case.scene.name for case in cases], order(options.study)))


def parsed() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("photos", nargs="+", help="folders of photos with cameras")
    parser.add_argument("--like", default="worlds/landmark-64", help="model that has the windows")
    parser.add_argument("--distances", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--windows", type=int, default=6, help="of a scene, at most")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file of all windows")
    return parser.parse_args()


def windows(options: argparse.Namespace) -> Iterator[Case]:
    """Windows of all scenes, at all distances."""
    files, domain = checkpoints([options.like]), trained_on(options.like)
    for place in options.photos:
        recipe = next(iter(recipes_alike(files, place).values()))
        scene = recipe.build_data().scenes("test")[0]
        for distance in options.distances:
            far = apart(domain, distance)
            for window in chosen(scene, recipe.views, far, options.windows, False):
                unscaled = constant_scale(recipe.views, 1.0)
                sample = make_sample(scene, *window, unscaled, mirror=False)
                yield Case(scene, recipe.views, *window, sample)


def score(model: QueryGaussianModel, case: Case) -> list[float]:
    """PSNR and SSIM of the novel views of a window, at the scale that is found."""
    search = ScaleSearch(model, case.views.model_copy(update={"scale": "search"}))
    factor = search(case.scene, case.inputs, case.targets).scale_factor
    return [*judged(model, case.sample, [factor])[factor]]


def copied(case: Case) -> list[float]:
    """PSNR and SSIM of the nearest photo."""
    targets = case.sample.targets
    seen = nearest_input(case.sample.inputs, targets.cameras)
    return [float(metric(seen, targets.images).mean()) for metric in (psnr, ssim)]


def order(study: Path) -> list[str]:
    """The variants, as the study has them."""
    results = study / "results.json"
    rows = json.loads(results.read_text("utf-8"))["table"] if results.is_file() else []
    return [*dict.fromkeys(row["variant"] for row in rows)]


def table(scores: dict[str, list[list[float]]], scenes: list[str], variants: list[str]) -> str:
    """A row for each variant: PSNR of each scene, PSNR and SSIM of all, the last difference."""
    runs = dict[str, dict[str, list[list[float]]]]()
    for run, values in scores.items():
        variant, seed = run.split("/")
        runs.setdefault(variant, {})[seed] = values
    names = ["nearest", *(name for name in variants if name in runs)]
    names += [name for name in runs if name not in names]
    places = [*dict.fromkeys(scenes)]
    lines = [f"| | {' | '.join(places)} | all | SSIM | to the row above |"]
    lines.append("|---|" + "--:|" * (len(places) + 3))
    before = dict[str, list[list[float]]]()
    for name in names:
        values = np.array([*runs[name].values()])  # (seeds, windows, 2)
        of = [values[:, np.array(scenes) == place, 0].mean() for place in places]
        cells = [f"{value:.2f}" for value in (*of, values[..., 0].mean())]
        cells.append(f"{values[..., 1].mean():.3f}")
        pairs = [(runs[name][seed], before[seed]) for seed in runs[name].keys() & before.keys()]
        gain = gained(np.array([np.subtract(own, old)[:, 0] for own, old in pairs]))
        lines.append(f"| {name} | {' | '.join([*cells, gain])} |")
        before = runs[name]
    return "\n".join(lines)


def gained(differences: np.ndarray) -> str:
    """Mean of differences (seeds, windows) and its interval; "" without a common seed."""
    if not differences.size:
        return ""
    low, high = interval(differences)
    mean = f"{differences.mean():+.2f}"
    return mean if low is None else f"{mean} [{low:+.2f}, {high:+.2f}]"


if __name__ == "__main__":
    main()
