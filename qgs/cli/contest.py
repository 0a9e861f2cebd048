"""Training and judging several recipes under one budget, and the report of it."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import yaml
from rich import box
from rich.table import Table
from torch import Tensor

from qgs.analysis.report import Baseline, Contender, Report
from qgs.composer import Recipe, resolve
from qgs.contracts import SceneSource
from qgs.data.evaluation import evaluation_samples
from qgs.data.sampling import Sample
from qgs.drawing.figures import Curves
from qgs.engine import Evaluation, RunFolder, evaluate, train
from qgs.io.ply import write_ply

SAME = ("data", "views", "evaluation", "training")
"""Parts of the recipes that must be equal, so that only the models differ."""


class StoppedError(Exception):
    """Someone stopped the contest; the argument is the signal's name."""


@dataclass(frozen=True)
class Entry:
    """One recipe after training and evaluation."""

    recipe: Recipe
    contender: Contender
    evaluation: Evaluation


def resolve_fairly(files: Sequence[Path], seconds: float, seed: int) -> dict[str, Recipe]:
    """Recipes by file name, under one time budget and seed.

    Raises ValueError when two files share a name, or differ in anything but the model and losses.
    """
    overrides = [f"training.seconds={seconds}", "training.steps=1000000000", f"seed={seed}"]
    recipes = {file.stem: resolve(file, overrides) for file in files}
    if len(recipes) < len(files):
        raise ValueError(f"recipes are told apart by file name, got {[f.name for f in files]}")
    first = next(iter(recipes))
    for name, recipe in recipes.items():
        unequal = [part for part in SAME if recipe.tree[part] != recipes[first].tree[part]]
        if unequal:
            raise ValueError(
                f"{name} and {first} differ in {', '.join(unequal)}, so their figures could not be "
                "compared; make these parts equal, or train them with `qgs train`"
            )
    return recipes


def compete(name: str, recipe: Recipe, run: Path, device: str = "auto") -> Entry:
    """Train and evaluate one recipe. Raises StoppedError when training was stopped."""
    result = train(recipe, run, device=device)
    if result.stopped_by:
        raise StoppedError(result.stopped_by)
    evaluation = evaluate(result.model, recipe, result.steps)
    evaluation.write(result.folder.evaluation)
    dispersion = evaluation.summary()["dispersion_over_gaussians"]
    contender = Contender(
        name=name,
        model=result.model.cpu(),
        psnr=mean_of(evaluation, "psnr"),
        ssim=mean_of(evaluation, "ssim"),
        dispersion_mean=dispersion["mean"]["mean"],
        dispersion_median=dispersion["median"]["median"],
        gaussians=evaluation.gaussians,
        parameters=sum(p.numel() for p in result.model.parameters()),
        seconds=result.seconds,
        curves=curves_of(result.folder),
        recipe=yaml.safe_dump(dict(recipe.tree), sort_keys=False, allow_unicode=True),
    )
    return Entry(recipe, contender, evaluation)


def curves_of(folder: RunFolder) -> Curves:
    """The history of a run, but for steps that were skipped."""
    names = ("seconds", "loss", "psnr")
    records = (record for record in folder.history() if not record.get("skipped"))
    history = [record for record in records if record.keys() >= set(names)]
    return Curves(*([record[name] for record in history] for name in names))


def mean_of(evaluation: Evaluation, metric: str, method: str = "model") -> float:
    """The mean over scenes. Raises ValueError for a metric that these images do not have."""
    value = evaluation.mean(metric, method)
    if value is None:
        raise ValueError(
            f"a contest compares {metric}, which is empty here ({evaluation.empty[metric]}): raise "
            "data.image_size"
        )
    return value


def baselines(entry: Entry) -> list[Baseline]:
    """What needs no model, on the views that `entry` was judged on."""
    return [
        Baseline(
            name, mean_of(entry.evaluation, "psnr", key), mean_of(entry.evaluation, "ssim", key)
        )
        for name, key in (("Nearest input", "nearest_input"), ("Mean colour", "mean_colour"))
    ]


def table_of(entries: Sequence[Entry]) -> Table:
    """The comparison as a table for the terminal."""
    rows = [entry.contender for entry in entries]
    caption = "median, mean: token dispersion in world units; best in green"
    table = Table(
        title="Unseen scenes",
        caption=caption,
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    table.add_column("", no_wrap=True)
    for column in ("PSNR", "SSIM", "median", "mean", "Gaussians", "parameters", "seconds"):
        table.add_column(column, justify="right", no_wrap=True)
    best = (
        max(c.psnr for c in rows),
        max(c.ssim for c in rows),
        min(c.dispersion_median for c in rows),
        min(c.dispersion_mean for c in rows),
    )
    for c in rows:
        scores = (c.psnr, c.ssim, c.dispersion_median, c.dispersion_mean)
        cells = [
            f"[green]{value:.{digits}f}[/green]" if value == top else f"{value:.{digits}f}"
            for value, top, digits in zip(scores, best, (2, 3, 3, 3), strict=True)
        ]
        cells += [f"{c.gaussians:,}", f"{c.parameters / 1e6:.2f} M", f"{c.seconds:.0f}"]
        table.add_row(c.name, *cells)
    table.add_section()
    for b in baselines(entries[0]):
        table.add_row(b.name, f"{b.psnr:.2f}", f"{b.ssim:.3f}", *["–"] * 5, style="dim")
    return table


PICTURED_SCENES = 3


def report_of(entries: Sequence[Entry], seconds: float, seed: int) -> Report:
    """The comparison, pictured on the first test scenes."""
    recipe = entries[0].recipe
    few = recipe.evaluation.model_copy(update={"scenes": PICTURED_SCENES, "samples": 1})
    source = recipe.build_data()
    samples = evaluation_samples(source, recipe.views, few)[:PICTURED_SCENES]
    names = [entry.contender.name for entry in entries]
    return Report(
        title=" and ".join(names) + f", {seconds:g} seconds of training each",
        contenders=[entry.contender for entry in entries],
        baselines=baselines(entries[0]),
        samples=samples,
        depths=[true_depth(source, sample) for sample in samples],
        facts=_facts([entry.recipe for entry in entries], seconds, seed),
    )


def true_depth(source: SceneSource, sample: Sample) -> Tensor | None:
    """Depth (T, 1, H, W) of the targets in the sample's units; None where the scene has none."""
    scene = next(scene for scene in source.scenes("test") if scene.name == sample.scene)
    depth = scene.depths(sample.target_frames)
    if depth is None:
        return None
    frames = [sample.input_frames[0], *sample.target_frames]
    own = scene.cameras[frames].c2w[:, :3, 3]
    cameras = sample.inputs.cameras.c2w[0, :1], sample.targets.cameras.c2w[0]
    return depth * float(_extent(torch.cat(cameras)[:, :3, 3]) / _extent(own))


def _extent(centres: Tensor) -> Tensor:
    return (centres - centres[0]).norm(dim=-1).amax()


@torch.no_grad()
def write_examples(report: Report, target: Path) -> None:
    """The first pictured scene as TARGET/NAME/example.ply, by every contender."""
    for contender in report.contenders:
        gaussians = contender.model(report.samples[0].inputs).gaussians
        write_ply(gaussians, target / contender.name / "example.ply")


def _facts(recipes: Sequence[Recipe], seconds: float, seed: int) -> dict[str, str]:
    data, views = recipes[0].tree["data"], recipes[0].views
    height, width = data["image_size"]
    plugins = {name: version for r in recipes for name, version in r.plugin_versions.items()}
    versions = [f"{name} {version}" for name, version in plugins.items()]
    device = f"CPU with {os.cpu_count()} cores ({platform.machine()})"
    if torch.cuda.is_available():
        device = torch.cuda.get_device_name()
    return {
        "Data": f"{data['type']}, {width} × {height} pixels",
        "Views": f"{views.inputs} inputs, judged on the views between them",
        "Budget": f"{seconds:g} seconds of training each, seed {seed}",
        "Machine": f"{device}, {torch.get_num_threads()} threads, {platform.system()}",
        "Software": ", ".join([f"torch {torch.__version__}", *versions]),
    }
