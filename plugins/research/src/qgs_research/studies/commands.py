"""The commands `qgs study`, `qgs compare` and `qgs diff`."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.inspect import RecipeFile
from qgs.cli.options import Device
from qgs_research import short_names

app = typer.Typer(help="Train variants of a model with several seeds, and compare them.")
compare_app = typer.Typer(help="Compare results of evaluations.")
diff_app = typer.Typer(help="Compare recipes.")

StudyFile = Annotated[
    str, typer.Argument(metavar="STUDY", help="Study file, or name of a study that comes with qgs.")
]


@compare_app.command()
def compare(
    runs: Annotated[
        list[str],
        typer.Argument(metavar="RUN...", help="Run folders, or folders that `qgs eval` wrote."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Write comparison.json and comparison.md to this folder.")
    ] = None,
    across_protocols: Annotated[
        bool,
        typer.Option("--across-protocols", help="Also compare results of different protocols."),
    ] = False,
) -> None:
    """Compare every RUN with the first one, scene by scene.

    The command reads stored results and evaluates no model. Runs of one recipe that differ only in
    their seed are compared as one model.
    """
    from qgs.evaluate.results import as_json
    from qgs.files import write_text
    from qgs_research.studies.stored import read_results
    from qgs_research.studies.tables import compare as compared
    from qgs_research.studies.tables import record, summary

    console = Console()
    scores = compared([read_results(run) for run in runs], across_protocols)
    summary(scores).show(console)
    if out:
        write_text(out / "comparison.json", as_json(record(scores)))
        write_text(out / "comparison.md", summary(scores).markdown)


@app.command()
def study(
    file: StudyFile,
    out: Annotated[Path, typer.Option(help="Folder of the study. Finished runs in it are kept.")],
    workers: Annotated[
        int, typer.Option(min=0, help="Number of parallel runs. 0 trains nothing and only reports.")
    ] = 1,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads per run. Default: cores / workers.")
    ] = None,
    only: Annotated[
        int | None, typer.Option(min=0, help="Train only this run, counted from 0. Default: all.")
    ] = None,
    device: Device = "auto",
) -> None:
    """Train every variant with every seed, evaluate all runs alike, and compare the scores.

    The whole study is checked before training. To continue after a stop, repeat the command.
    OUT/table.md gets the answer of the study and tables of the scores; OUT/results.json gets all
    numbers.

        study: 1
        base: tiny/locus.yaml
        variants:
          locus:
          mine: {model: {decoder: {cross_attention: {sigma0: 0.2}}}}
        reference: locus
        seeds: [0, 1, 2]
        budget: {steps: 2100}   # or seconds
        hypotheses:
          - mine > locus

        qgs study mine_study.yaml --out studies/mine --workers 2

    A variant changes `base` or names a recipe file. docs/studies.md explains all keys.
    """
    from qgs_research.studies.running import run_study

    raise typer.Exit(run_study(file, out, workers, threads, only, device))


@diff_app.command()
def diff(
    first: RecipeFile,
    second: RecipeFile,
    set_a: Annotated[
        list[str] | None, typer.Option("--set-a", help="Override for the first recipe; repeatable.")
    ] = None,
    set_b: Annotated[
        list[str] | None,
        typer.Option("--set-b", help="Override for the second recipe; repeatable."),
    ] = None,
) -> None:
    """Show which slots and options of two recipes differ, and their numbers of parameters.

    "-" marks an option that does not exist in one of the recipes.
    """
    from qgs.model_text import parameter_counts
    from qgs.recipe import resolve
    from qgs.recipe.recipe import differing_options
    from qgs.terminal import print_table

    ours = resolve(first, set_a or ())
    theirs = resolve(second, set_b or ())
    names = short_names([first, second])
    slots = [["slot", *names]]
    options = [["option", *names]]
    for path, values in differing_options(ours.tree, theirs.tree).items():
        # Another component has other options, so name the components first.
        rows = slots if path.endswith(".type") else options
        rows.append([path.removesuffix(".type"), *(value or "-" for value in values)])
    # sizes need no memory for weights
    before, after = (Counter(parameter_counts(x.build_model("meta"))) for x in (ours, theirs))
    parameters = [["component", *names, "difference"]]
    sizes = [(name, before[name], after[name]) for name in {**before, **after}]
    for name, old, new in [*sizes, ("total", before.total(), after.total())]:
        change = f"{new - old:+,}" if new != old else ""
        parameters.append([name, f"{old:,}", f"{new:,}", change])
    console = Console()
    print_table(console, "slots that differ", slots)
    print_table(console, "options that differ", options)
    print_table(console, "parameters", parameters)
