"""Write report.html, a single file with pictures inside, which compares trained models."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich import box
from rich.console import Console
from rich.text import Text

from qgs.contracts import Column
from qgs.files import write_text
from qgs.metrics.baselines import BASELINES
from qgs.recipe.slots import summary_of
from qgs.terminal import print_lines, print_table
from qgs.wording import counted, listed
from qgs_viewer import sections, trust
from qgs_viewer.comparison import Model
from qgs_viewer.look import page_environment
from qgs_viewer.remarks import remarks
from qgs_viewer.scenes import ModelScenes, model_scenes
from qgs_viewer.sections import Detail

PICTURED_SCENES = 3
# Target views of each scene that are shown.
TARGETS = 2
RANKED = 5
"""Least number of samples with which a report ranks models."""


@dataclass(frozen=True)
class Comparison:
    """Contents of a report that compares models on the same scenes.

    models: compared models, in the order of the report. facts: lines about the training, by their
    label. commands: shell commands that a reader may run next, with what each command does. scenes:
    heading of the pictures. notes: sentences below the table of scores.
    """

    models: Sequence[Model]
    facts: Mapping[str, str]
    commands: Mapping[str, str]
    scenes: str = "Unseen scenes"
    notes: Sequence[str] = ()


def score_rows(
    models: Sequence[Model], columns: Mapping[str, Column]
) -> dict[str, list[tuple[str, bool]]]:
    """Return the table of scores as rows by name: first the models, then the baselines.

    columns: what to show, by name; "coverage" is that of `trust.means`. A cell is a pair: its text,
    and True if its value is the best of all rows. With fewer than RANKED samples no value is
    marked.
    """
    first = models[0].evaluation
    means: dict[str, Mapping[str, float | None]] = {}
    sizes = {}
    for model in models:
        found = model.evaluation
        # of the views that the evaluation has scored
        coverage = 100 * trust.means(model.views).coverage
        means[model.name] = {**found.means(), "coverage": coverage}
        sizes[model.name] = [f"{found.gaussians:,}", f"{model.parameters:,}"]
    for baseline in BASELINES:
        means[baseline.replace("_", " ").capitalize()] = first.means(baseline)
    rows = {}
    for label, own in means.items():
        cells = rows[label] = list[tuple[str, bool]]()
        for name, column in columns.items():
            cell = column.shown(own.get(name))
            best = column.best(other.get(name) for other in means.values())
            # cells that read alike are both best
            alike = best is not None and cell == column.shown(best)
            cells.append((cell, alike and label in sizes and first.samples >= RANKED))
        # baselines have neither Gaussians nor parameters
        cells += [(size, False) for size in sizes.get(label, ["–", "–"])]
    return rows


def verdicts(models: Sequence[Model]) -> dict[str, str]:
    """Return the verdict on each model, by name."""
    return {model.name: trust.verdict(model.views) for model in models}


def show_scores(comparison: Comparison, console: Console) -> None:
    """Print the table of scores in the terminal, with the best values in green."""
    # the verdicts give the coverage, for which a narrow terminal has no column
    columns = comparison.models[0].evaluation.columns
    titles = [column.title for column in columns.values()]
    lines: list[Sequence[str | Text]] = [["", *titles, "Gaussians", "parameters"]]
    for name, row in score_rows(comparison.models, columns).items():
        lines.append([name, *(Text(cell, "green" if best else "") for cell, best in row)])
    samples = comparison.models[0].evaluation.samples
    marks = "best in green" if samples >= RANKED else "too few to rank models"
    title = f"{comparison.scenes}, {counted(samples, 'sample')}, {marks}"
    print_table(console, title, lines, box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)


@torch.no_grad()
def report_html(comparison: Comparison, shown: Sequence[ModelScenes]) -> str:
    """Return the whole report as HTML, which needs no other file and no network.

    shown: the models of the comparison with their reconstructions of the scenes to show.
    """
    models = comparison.models
    first = models[0]
    scenes = [
        sections.pictured_scene(shown, place, range(len(sample.target_frames))[:TARGETS])
        for place, sample in enumerate(shown[0].samples)
    ]
    ranked = [view for scene in scenes for view in scene["views"]]
    # the best first, by the first model
    ranked.sort(key=lambda view: -view[0])
    drawn = (sections.queries, sections.anchors, sections.cross_attention, sections.curves)
    height, width = first.recipe.tree["data"]["image_size"]
    data = f"{first.recipe.tree['data']['type']}, {width} × {height} pixels"
    unseen = not any(score.given for score in first.evaluation.scores)
    judged = "beside" if first.windows else "between"
    samples = counted(first.evaluation.samples, "sample")
    inputs = sorted({len(sample.input_frames) for sample in shown[0].samples})
    scored = f"views {judged} the inputs" if unseen else "the inputs"
    views = f"{samples}, {listed(inputs)} inputs, scored on {scored}"
    names = listed((model.name for model in models), most=3)
    parts = first.recipe.parts.items()
    meanings = [summary_of(part.component) for place, part in parts if place[0] == "metrics"]
    head, *others = first.evaluation.columns.items()
    columns = dict([head, ("coverage", trust.COVERAGE), *others])
    template = page_environment().get_template("report.html")
    return template.render(
        comparison=comparison,
        title=f"{names}: {comparison.scenes.lower()}",
        columns=columns,
        rows=score_rows(models, columns),
        facts={"Data": data, "Views": views, **comparison.facts},
        meanings=meanings,
        scenes=scenes,
        views=ranked,
        turned=sections.scene_to_turn(shown),
        verdicts=verdicts(models),
        unseen=unseen,
        sections=[section(shown, Detail()) for section in drawn],
    )


def write_report(comparison: Comparison, folder: Path, console: Console) -> None:
    """Print remarks, scores and commands to run next; write report.html into `folder`."""
    notes = remarks(comparison.models)
    print_lines(console, notes)
    comparison = replace(comparison, notes=[*comparison.notes, *notes])
    show_scores(comparison, console)
    print_lines(console, [f"{name}: {text}" for name, text in verdicts(comparison.models).items()])
    # the table first: the page takes longer
    console.print("writing the page", style="dim")
    page = folder / "report.html"
    write_text(page, report_html(comparison, model_scenes(comparison.models, PICTURED_SCENES)))
    console.print(f"\n[bold]Report:[/bold] {page.resolve()}", soft_wrap=True)
    # a comment to the shell, so that lines can be pasted
    lines = [f"  {command}  # {purpose}" for command, purpose in comparison.commands.items()]
    print_lines(console, ["Next:", *lines])
