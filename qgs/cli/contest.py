"""Training and judging several recipes under one budget, and the report of it."""

import os
import platform
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import typer
import yaml
from rich import box
from rich.table import Table

from qgs.analysis.report import Contender, Report
from qgs.composer import Recipe, resolve
from qgs.composer.schema import summary_of
from qgs.data.evaluation import evaluation_samples, true_depth
from qgs.drawing.figures import Curves
from qgs.engine.evaluation import Evaluation, evaluate
from qgs.engine.training import train
from qgs.io.files import read_records
from qgs.io.ply import save_ply
from qgs.metrics.baselines import BASELINES
from qgs.model import QueryGaussianModel
from qgs.wording import counted, listed, short_names

PICTURED_SCENES = 6
NEXT = {
    "qgs demo PHOTOS": "shows this on a folder of your own photos, with camera poses",
    "qgs reconstruct MODEL PHOTOS --out scene --refine 30": "reconstructs and refines them",
    "qgs view MODEL PHOTOS": "shows the scene in the browser, to turn and to pick queries in",
    "qgs recipes": "lists recipes, each a model to train or to change",
}
"""Commands that a reader of a report may want, and what they do."""
JUDGED = ("data", "views", "evaluation", "metrics")
TRAINED = ("optimizer", "training")
"""Parts of recipes that must be equal, so that only the models differ."""
OF_THE_METHOD = ("optimizer.parts", "training.judge_inputs", "evaluation.tuning")
"""What may differ all the same: how a method trains, and what nobody tunes here."""


@dataclass(frozen=True)
class Entry:
    """One recipe after training and evaluation."""

    recipe: Recipe
    contender: Contender
    evaluation: Evaluation


def resolve_fairly(files: Sequence[Path], seconds: float, seed: int) -> dict[str, Recipe]:
    """Recipes by short name, under one time budget and seed.

    Raises ValueError when two files differ in anything but model, losses and `OF_THE_METHOD`.
    """
    overrides = [f"training.seconds={seconds}", "training.steps=1000000000", f"seed={seed}"]
    names = short_names(files)
    recipes = {name: resolve(f, overrides) for name, f in zip(names, files, strict=True)}
    first = next(iter(recipes))
    for name, recipe in recipes.items():
        refuse_unequal(name, recipe, first, recipes[first], (*JUDGED, *TRAINED))
    return recipes


def refuse_unequal(
    name: str, recipe: Recipe, other: str, others: Recipe, parts: Sequence[str]
) -> None:
    """Raise ValueError where two recipes differ in one of `parts`, but for `OF_THE_METHOD`."""

    def compared(part: str, of: Recipe) -> dict[str, Any]:
        options = of.tree[part] or {}
        return {name: x for name, x in options.items() if f"{part}.{name}" not in OF_THE_METHOD}

    if unequal := [part for part in parts if compared(part, recipe) != compared(part, others)]:
        raise ValueError(
            f"{name} and {other} differ in {', '.join(unequal)}, so their figures could not be "
            "compared; make these parts equal, or take one at a time"
        )


def compete(name: str, recipe: Recipe, run: Path, device: str = "auto") -> Entry:
    """Train and evaluate one recipe. Raises typer.Exit when training was stopped."""
    result = train(recipe, run, device=device)
    if result.stopped_by:
        typer.echo(f"stopped by {result.stopped_by}; no report", err=True)
        raise typer.Exit(128 + signal.Signals[result.stopped_by])
    evaluation = evaluate(result.model, recipe, result.steps)
    evaluation.write(result.folder.evaluation)
    curves = curves_of(result.folder.checkpoint)
    return entry_of(name, recipe, evaluation, result.model, curves=curves)


def entry_of(
    name: str,
    recipe: Recipe,
    evaluation: Evaluation,
    model: QueryGaussianModel,
    about: str = "",
    curves: Curves | None = None,
) -> Entry:
    """A judged model, which moves to the CPU. about, curves: see `Contender`."""
    contender = Contender(
        name=name,
        model=model.cpu(),
        scores=evaluation.means(),
        gaussians=evaluation.gaussians,
        parameters=sum(p.numel() for p in model.parameters()),
        recipe=yaml.safe_dump(dict(recipe.tree), sort_keys=False, allow_unicode=True),
        about=about or _about(recipe),
        curves=curves,
    )
    return Entry(recipe, contender, evaluation)


def _about(recipe: Recipe) -> str:
    """What the queries are and how they read the photos, in the words of these components."""
    first = ("model", "decoder", "layers", "0")
    readers = (*first, "cross_attention"), (*first, "layer"), ("model", "encoder")
    reader = next(place for place in readers if place in recipe.parts)
    chosen = [recipe.parts[place] for place in (("model", "queries"), reader)]
    more = ["Trained on its input views too."] if recipe.training.judge_inputs else []
    return " ".join([*(f"{part.type}: {summary_of(part.component)}" for part in chosen), *more])


def curves_of(file: Path) -> Curves | None:
    """NAME.history.jsonl beside NAME.safetensors, or its run's history, but for skipped steps."""
    own, names = file.with_suffix(".history.jsonl"), ("seconds", "loss", "psnr", "step")
    records = read_records(own if own.is_file() else file.with_name("history.jsonl"))
    steps = [r for r in records if not r.get("skipped") and r.keys() >= set(names)]
    return Curves(*([step[name] for step in steps] for name in names)) if steps else None


def baselines(entry: Entry) -> dict[str, dict[str, float | None]]:
    """Scores, by name, of what needs no model on the views that `entry` was judged on."""
    return {n.replace("_", " ").capitalize(): entry.evaluation.means(n) for n in BASELINES}


def table_of(entries: Sequence[Entry], title: str = "Unseen scenes") -> Table:
    """The comparison as a table for the terminal."""
    rows = [entry.contender for entry in entries]
    columns = entries[0].evaluation.columns
    table = Table(title=title, caption="best in green", box=box.SIMPLE_HEAD)
    table.pad_edge, table.collapse_padding = False, True
    table.add_column("", no_wrap=True)
    headings = [column.title for column in columns.values()]
    for heading in (*headings, "Gaussians", "parameters"):
        table.add_column(heading, justify="right")
    best = {name: column.best(c.scores[name] for c in rows) for name, column in columns.items()}
    for c in rows:
        cells = []
        for name, column in columns.items():
            score, cell = c.scores[name], column.shown(c.scores[name])
            is_best = score is not None and score == best[name]
            cells.append(f"[green]{cell}[/green]" if is_best else cell)
        table.add_row(c.name, *cells, f"{c.gaussians:,}", f"{c.parameters / 1e6:.2f} M")
    table.add_section()
    for baseline, scores in baselines(entries[0]).items():
        cells = [column.shown(scores[name]) for name, column in columns.items()]
        table.add_row(baseline, *cells, "–", "–", style="dim")
    return table


def report_of(
    entries: Sequence[Entry],
    lede: str,
    facts: Mapping[str, str],
    scenes: str = "Unseen scenes",
    notes: Sequence[str] = (),
) -> Report:
    """The comparison, pictured on PICTURED_SCENES test scenes; the rest as in `Report`."""
    recipe = entries[0].recipe
    few = recipe.evaluation.model_copy(update={"scenes": PICTURED_SCENES, "samples": 1})
    source = recipe.build_data()
    samples = evaluation_samples(source, recipe.views, few)[:PICTURED_SCENES]
    height, width = recipe.tree["data"]["image_size"]
    plugins = {name: v for entry in entries for name, v in entry.recipe.plugin_versions.items()}
    software = {"torch": torch.__version__, **plugins}
    device = f"CPU with {os.cpu_count()} cores ({platform.machine()})"
    if torch.cuda.is_available():
        device = torch.cuda.get_device_name()
    threads = counted(torch.get_num_threads(), "thread")
    names = listed((entry.contender.name for entry in entries), most=3)
    return Report(
        columns=entries[0].evaluation.columns,
        title=f"{names}: {scenes.lower()}",
        lede=lede,
        scenes=scenes,
        notes=notes,
        meanings=[summary_of(p.component) for at, p in recipe.parts.items() if at[0] == "metrics"],
        commands=NEXT,
        contenders=[entry.contender for entry in entries],
        baselines=baselines(entries[0]),
        samples=samples,
        depths=[true_depth(source, sample) for sample in samples],
        facts={
            "Data": f"{recipe.tree['data']['type']}, {width} × {height} pixels",
            "Views": f"{recipe.views.inputs} inputs, judged on the views between them",
            **facts,
            "Machine": f"{device}, {threads}, {platform.system()}",
            "Software": ", ".join(f"{name} {version}" for name, version in software.items()),
        },
    )


@torch.no_grad()
def write_examples(report: Report, target: Path) -> None:
    """The first pictured scene as TARGET/NAME/example.ply, by every contender."""
    for contender in report.contenders:
        gaussians = contender.model(report.samples[0].inputs).gaussians
        save_ply(gaussians, target / contender.name / "example.ply")
