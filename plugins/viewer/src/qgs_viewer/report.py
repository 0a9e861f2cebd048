"""report.html: how trained models compare, in one page that needs no other file."""

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qgs.checkpoint.gaussians import save_ply
from qgs.drawing import images, page_environment
from qgs.drawing.figures import hex_color
from qgs.evaluate.results import print_lines
from qgs.files import write_text
from qgs.metrics.baselines import BASELINES
from qgs.recipe.schema import summary_of
from qgs.wording import counted, listed
from qgs_viewer import sections
from qgs_viewer.comparison import Result
from qgs_viewer.remarks import remarks
from qgs_viewer.scenes import ModelScenes, model_scenes
from qgs_viewer.sections import Detail

PICTURED_SCENES = 6
# Target views of each scene that are shown.
TARGETS = 2


@dataclass(frozen=True)
class Comparison:
    """Results of several models on the same scenes, in the order of the report.

    lede: a sentence or two below the title. facts: of training. commands: next commands, with what
    each does. scenes: heading of the pictures. notes: below the table, before the
    remarks on results.
    """

    results: Sequence[Result]
    lede: str
    facts: Mapping[str, str]
    commands: Mapping[str, str]
    scenes: str = "Unseen scenes"
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Row:
    """A line of the table of scores: cells, and if no other model has a better value."""

    name: str
    cells: Sequence[tuple[str, bool]]
    baseline: bool = False


def score_rows(results: Sequence[Result]) -> list[Row]:
    """Return the scores of all models, then those of the baselines."""
    columns = results[0].evaluation.columns
    rows = []
    for result in results:
        cells = []
        for name, column in columns.items():
            cell = column.shown(result.scores[name])
            best = column.best(other.scores[name] for other in results)
            # cells that read alike are both best
            cells.append((cell, best is not None and cell == column.shown(best)))
        sizes = (result.evaluation.gaussians, result.parameters)
        rows.append(Row(result.name, [*cells, *((f"{size:,}", False) for size in sizes)]))
    for baseline in BASELINES:
        means = results[0].evaluation.means(baseline)
        shown = [column.shown(means[name]) for name, column in columns.items()]
        # they have neither Gaussians nor parameters
        cells = [(cell, False) for cell in (*shown, "–", "–")]
        rows.append(Row(baseline.replace("_", " ").capitalize(), cells, baseline=True))
    return rows


def show_scores(comparison: Comparison, console: Console) -> None:
    """Print the table of scores."""
    look = {"box": box.SIMPLE_HEAD, "pad_edge": False, "collapse_padding": True}
    table = Table(title=comparison.scenes, caption="best in green", **look)
    # headings may wrap where a terminal is narrow, names may not
    table.add_column("", no_wrap=True)
    columns = comparison.results[0].evaluation.columns.values()
    for heading in (*(column.title for column in columns), "Gaussians", "parameters"):
        table.add_column(heading, justify="right")
    for row in score_rows(comparison.results):
        cells = [f"[green]{cell}[/green]" if best else cell for cell, best in row.cells]
        table.add_row(escape(row.name), *cells, style="dim" if row.baseline else None)
    console.print(table)


def facts_of(results: Sequence[Result]) -> dict[str, str]:
    """Return what was judged, and on which machine by which software, by headings."""
    recipe = results[0].recipe
    height, width = recipe.tree["data"]["image_size"]
    judged = "beside" if results[0].windows else "between"
    machine = f"CPU with {os.cpu_count()} cores ({platform.machine()})"
    if torch.cuda.is_available():
        machine = torch.cuda.get_device_name()
    software = {"torch": torch.__version__}
    for result in results:
        # versions of plug-ins that these models were built by
        software |= {name: v for name, (_, v) in result.recipe.releases.items()}
    threads = counted(torch.get_num_threads(), "thread")
    return {
        "Data": f"{recipe.tree['data']['type']}, {width} × {height} pixels",
        "Views": f"{recipe.views.inputs} inputs, judged on views {judged} them",
        "Machine": f"{machine}, {threads}, {platform.system()}",
        "Software": ", ".join(f"{name} {version}" for name, version in software.items()),
    }


@torch.no_grad()
def report_html(comparison: Comparison, models: Sequence[ModelScenes]) -> str:
    """Return the whole page; it needs no other file and no network.

    models: what the models of the comparison make of the pictured scenes.
    """
    results = comparison.results
    recipe = results[0].recipe
    detail = Detail()
    found = [
        sections.orbit(models),
        sections.scene_to_turn(models),
        sections.queries(models, detail),
        sections.anchors(models, detail),
        sections.attention(models, detail),
        sections.training_curves(models, detail),
    ]
    samples = models[0].samples
    names = listed((result.name for result in results), most=3)
    metrics = [part for place, part in recipe.parts.items() if place[0] == "metrics"]
    environment = page_environment("qgs_viewer", uri=images.data_uri, hex=hex_color)
    return environment.get_template("report.html").render(
        comparison=comparison,
        title=f"{names}: {comparison.scenes.lower()}",
        columns=results[0].evaluation.columns.values(),
        rows=score_rows(results),
        facts={**facts_of(results), **comparison.facts},
        meanings=[summary_of(metric.component) for metric in metrics],
        scenes=[
            sections.pictured_scene(models, place, range(len(sample.target_frames))[:TARGETS])
            for place, sample in enumerate(samples)
        ],
        sections=[section for section in found if section.rows],
    )


def write_report(comparison: Comparison, folder: Path, console: Console) -> None:
    """Show the scores; write the page, and the first scene of every model as a PLY."""
    notes = remarks(comparison.results)
    print_lines(console, notes)
    comparison = replace(comparison, notes=[*comparison.notes, *notes])
    models = model_scenes(comparison.results, PICTURED_SCENES)
    show_scores(comparison, console)
    for name, fact in comparison.facts.items():
        console.print(f"{name}: {fact}", soft_wrap=True, highlight=False, style="dim")
    # the table first: the page takes longer
    page = folder / "report.html"
    write_text(page, report_html(comparison, models))
    console.print(f"\n[bold]Report:[/bold] {page.resolve()}", soft_wrap=True)
    for model in models:
        ply = folder / model.name / "example.ply"
        save_ply(model.gaussians[0], ply)
        console.print(f"{model.name}: {ply}", soft_wrap=True)
    # a comment to the shell, so that lines can be pasted
    lines = [f"  {command}  # {purpose}" for command, purpose in comparison.commands.items()]
    print_lines(console, ["Next:", *lines])
