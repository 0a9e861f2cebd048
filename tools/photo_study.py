"""The models of a study on photos that none was trained on.

    python tools/photo_study.py STUDY PHOTOS ... [--like worlds/landmark-64] [--distances .5 1 2]
        [--figure PICTURE] [--out JSON]

STUDY: what `qgs study` wrote. Windows are those that `qgs demo` chooses for the model --like, and
inputs as far apart as tools/real_photos.py says; the same for all. Every model's scale is searched.
Prints Markdown: novel views of each scene by variant, then for each claim of the study the
difference on photos over all windows, with its 95 % interval over trainings and windows. With --out
a second call measures new trainings alone.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image
from qgs_research.studies.intervals import interval
from qgs_viewer.contest import checkpoints, recipes_alike
from real_photos import apart, chosen, judged, trained_on

from qgs.checkpoint.model_file import load
from qgs.contracts import Frames, Scene, ViewsConfig
from qgs.data.samples import Sample, make_sample
from qgs.drawing.figures import INK, MUTED, categorical, figure_picture, figure_style, hex_color
from qgs.files import replacing, write_text
from qgs.metrics.baselines import nearest_input
from qgs.metrics.images import psnr, ssim
from qgs.model import QueryGaussianModel
from qgs.reconstruction.scale import ScaleSearch, constant_scale

Scores: TypeAlias = dict[str, list[list[float]]]
"""By "VARIANT/seed-N", or "nearest/": PSNR and SSIM of each window."""

Runs: TypeAlias = dict[str, dict[str, np.ndarray]]
"""By variant and seed: PSNR and SSIM of windows (W, 2)."""


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
    scores = measured(options, cases, [file.parents[1] for file in trained])
    reported, runs = results(options.study), runs_of(scores)
    order = dict.fromkeys(row["variant"] for row in reported["table"])
    names = ["nearest", *(name for name in order if name in runs)]
    if options.figure:
        with replacing(options.figure) as file:
            picture = Image.fromarray(figure_picture(figure(runs, names[1:])))
            picture.save(file, format=options.figure.suffix[1:])
    print(table(runs, [case.scene.name for case in cases], names))
    print(claims(runs, reported["hypotheses"]))


def parsed() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("photos", nargs="+", help="folders of photos with cameras")
    parser.add_argument("--like", default="worlds/landmark-64", help="model that has the windows")
    parser.add_argument("--distances", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--windows", type=int, default=6, help="of a scene, at most")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file of all scores; those in it are kept")
    parser.add_argument("--figure", type=Path, help="picture of PSNR by variant, PNG or WebP")
    return parser.parse_args()


def windows(options: argparse.Namespace) -> Iterator[Case]:
    """Windows of all scenes, at all distances; one that is the best at several comes once."""
    files, domain = checkpoints([options.like]), trained_on(options.like)
    for place in options.photos:
        recipe = next(iter(recipes_alike(files, place).values()))
        scene, unscaled = recipe.build_data().scenes("test")[0], constant_scale(recipe.views, 1.0)
        found = dict.fromkeys(
            window
            for distance in options.distances
            for window in chosen(
                scene, recipe.views, apart(domain, distance), options.windows, False
            )
        )
        for window in found:
            sample = make_sample(scene, *window, unscaled, mirror=False)
            yield Case(scene, recipe.views, *window, sample)


def measured(options: argparse.Namespace, cases: list[Case], trained: list[Path]) -> Scores:
    """Scores of the nearest photo and of all trained runs; those that the file has are kept."""
    file: Path | None = options.out
    of = {
        "study": str(options.study.resolve()),
        "like": options.like,
        "windows": [[case.scene.name, [*case.inputs], [*case.targets]] for case in cases],
    }
    known = json.loads(file.read_text("utf-8")) if file and file.exists() else None
    if known and any(known[key] != value for key, value in of.items()):
        raise SystemExit(f"{file} has scores of another study, or windows: name another file")
    scores: Scores = known["scores"] if known else {"nearest/": [copied(case) for case in cases]}
    for run in trained:
        name = "/".join(run.parts[-2:])
        if name not in scores:
            model = load(run, "cpu").eval()
            scores[name] = [score(model, case) for case in cases]
            if file:
                write_text(file, json.dumps(of | {"scores": scores}, indent=1))
    return scores


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


def results(study: Path) -> dict[str, Any]:
    """What `qgs study` reported."""
    return json.loads((study / "results.json").read_text("utf-8"))


def runs_of(scores: Scores) -> Runs:
    """The scores by variant and seed."""
    runs: Runs = {}
    for run, values in scores.items():
        variant, seed = run.split("/")
        runs.setdefault(variant, {})[seed] = np.array(values)
    return runs


def table(runs: Runs, scenes: list[str], variants: list[str]) -> str:
    """A row for each variant: PSNR of each scene, PSNR and SSIM of all."""
    places = [*dict.fromkeys(scenes)]
    lines = [f"| | {' | '.join(places)} | all | SSIM |", "|---|" + "--:|" * (len(places) + 2)]
    for name in variants:
        values = np.stack([*runs[name].values()])  # (seeds, windows, 2)
        of = [values[:, np.array(scenes) == place, 0].mean() for place in places]
        cells = [f"{value:.2f}" for value in (*of, values[..., 0].mean())]
        lines.append(f"| {name} | {' | '.join(cells)} | {values[..., 1].mean():.3f} |")
    return "\n".join(lines)


def claims(runs: Runs, hypotheses: list[dict[str, Any]]) -> str:
    """A row for each pair of variants that the study compares: PSNR of the first minus the other's.

    Seeds are paired. Claims on rooms are left out.
    """
    lines = ["", "| on photos | dB |", "|---|--:|"]
    for hypothesis in hypotheses:
        if "@rooms" in hypothesis["claim"]:
            continue
        left, sign, right = (part.split("@")[0] for part in hypothesis["claim"].split())
        own, other = runs.get(left, {}), runs.get(right, {})
        pairs = [own[seed] - other[seed] for seed in own if seed in other]
        if pairs:
            lines.append(f"| {left} {sign} {right} | {gained(np.stack(pairs)[..., 0])} |")
    return "\n".join(lines)


def figure(runs: Runs, variants: list[str]) -> Figure:
    """PSNR over all windows: a point for each training, a line for the mean, one for copying."""
    with figure_style():
        drawn = Figure(figsize=(6.4, 0.8 + 0.28 * len(variants)), layout="constrained")
        axes = drawn.subplots()
        for place, name in enumerate(variants):
            means = [values[:, 0].mean() for values in runs[name].values()]
            axes.plot(means, [place] * len(means), "o", color=hex_color(categorical(0)))
            axes.plot(np.mean(means), place, "|", color=hex_color(INK), markersize=14)
        at, muted = runs["nearest"][""][:, 0].mean(), hex_color(MUTED)
        axes.axvline(at, color=muted, linestyle="--", label="nearest photo")
        axes.set(yticks=range(len(variants)), yticklabels=variants, xlabel="PSNR on photos, dB")
        axes.invert_yaxis()
        drawn.legend(loc="outside upper right")
    return drawn


def gained(differences: np.ndarray) -> str:
    """Mean of differences (seeds, windows), and its interval where there are several seeds."""
    low, high = interval(differences)
    mean = f"{differences.mean():+.2f}"
    return mean if low is None else f"{mean} [{low:+.2f}, {high:+.2f}]"


if __name__ == "__main__":
    main()
