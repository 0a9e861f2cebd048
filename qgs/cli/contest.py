"""Training and judging several recipes under one budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from rich import box
from rich.table import Table

from qgs.analysis.pictures.figures import Curves
from qgs.analysis.report import Baseline, Contender
from qgs.composer import Recipe, resolve
from qgs.engine import Evaluation, RunFolder, evaluate, train

SAME = ("data", "views", "evaluation", "training")
"""Parts of the recipes that must be equal, so that only the models differ."""

NO_STEP_LIMIT = 1_000_000_000


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
    overrides = [
        f"training.seconds={seconds}",
        f"training.steps={NO_STEP_LIMIT}",
        f"seed={seed}",
    ]
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
