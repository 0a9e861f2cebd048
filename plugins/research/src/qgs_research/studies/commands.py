"""`qgs study` and `qgs compare`."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer
from rich.console import Console

from qgs.cli.options import Device
from qgs.wording import counted

if TYPE_CHECKING:
    from qgs_research.studies.runs import Plan

app = typer.Typer(help="Train variants of a model by seeds, and compare them.")
compare_app = typer.Typer(help="Compare results of evaluations.")


@compare_app.command()
def compare(
    runs: Annotated[
        list[str], typer.Argument(metavar="RUN...", help="Run folders, or folders of `qgs eval`.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for comparison.json and comparison.md.")
    ] = None,
    across_protocols: Annotated[
        bool, typer.Option("--across-protocols", help="Compare results of different protocols.")
    ] = False,
) -> None:
    """Compare the results of the first RUN with those of each other, scene by scene.

    Nothing is evaluated. Runs of one recipe with several seeds count as one side.
    """
    from qgs.evaluate.results import as_json, print_lines
    from qgs.files import write_text
    from qgs_research.studies.comparison import compare as compared
    from qgs_research.studies.comparison import record, summary
    from qgs_research.studies.stored import read_results

    console = Console()
    scores = compared([read_results(run) for run in runs], across_protocols)
    summary(scores).show(console)
    if out:
        write_text(out / "comparison.json", as_json(record(scores)))
        write_text(out / "comparison.md", summary(scores).markdown)
    end = f"written to {out}" if out else "add --out FOLDER to keep this as JSON and Markdown"
    print_lines(console, [end])


Workers: TypeAlias = Annotated[
    int, typer.Option(min=0, help="Runs at a time here; 0 trains nothing, and only reports.")
]
RunThreads: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="CPU threads of a run; default: cores / workers.")
]
Only: TypeAlias = Annotated[
    int | None, typer.Option(min=0, help="Train the run of this number, from 0, alone.")
]

StudyFile: TypeAlias = Annotated[
    str, typer.Argument(metavar="STUDY", help="Study file, or one that comes with qgs.")
]
StudyFolder: TypeAlias = Annotated[
    Path, typer.Option("--out", help="Folder of the study; what is there already is not run again.")
]


@app.command()
def study(
    file: StudyFile,
    out: StudyFolder,
    workers: Workers = 1,
    threads: RunThreads = None,
    only: Only = None,
    device: Device = "auto",
) -> None:
    """Train every variant with every seed, evaluate all by one protocol, and compare the scores.

    It is checked as a whole before anything trains. The same command goes on
    at any time. OUT/study.html has the answer, OUT/results.json the numbers.

    \b
        study: 1
        base: tiny/locus.yaml
        variants:
          locus:
          mine: {model: {decoder: {cross_attention: {sigma0: 0.2}}}}
        reference: locus
        seeds: [0, 1, 2]
        budget: {steps: 2100}   # or seconds, or images
        hypotheses:
          - mine > locus

    \b
        qgs study mine_study.yaml --out studies/mine --workers 2

    A variant changes `base`, or names a recipe file; docs/studies.md has all keys.
    """
    from qgs.evaluate.results import print_lines
    from qgs_research.studies.plan import planned
    from qgs_research.studies.queue import Queue
    from qgs_research.studies.runs import write_plan
    from qgs_research.studies.study import read_study

    console = Console()
    with console.status("composing and checking all variants"):
        plan = planned(read_study(file), out)
        write_plan(plan)
    for name, recipe in plan.recipes.items():
        print_lines(console, [f"warning: {name}: {warning}" for warning in recipe.warnings])
    missing = sum(not plan.done(run) for run in plan.runs)
    print_lines(console, [f"{plan.size}: {counted(len(plan.runs), 'run')}, {missing} missing"])
    queue = Queue(
        plan=plan,
        runs=plan.runs if only is None else [plan.runs[only]],
        workers=workers,
        threads=threads or max(_usable_cores() // max(workers, 1), 1),
        device=device,
        console=console,
        gpus=_gpus(device),
    )
    stopped = queue.work() if workers and missing else None
    print_lines(console, [_reported(plan, console)])
    if stopped:
        print_lines(console, [f"stopped by {stopped}; the same command goes on"])
        raise typer.Exit(128 + signal.Signals[stopped])
    if queue.failures:
        raise typer.Exit(1)


def _reported(plan: Plan, console: Console) -> str:
    """Write the results of what is finished and show them; return where they are."""
    from qgs_research.studies.output import study_summary, write_all
    from qgs_research.studies.results import Results

    results = Results(plan)
    if not results.columns:
        return "no run is finished: there is nothing to report yet"
    folder = write_all(results)
    study_summary(results).show(console)
    return f"written to {folder}"


def _gpus(device: str) -> list[str]:
    """GPUs that may be used, as CUDA_VISIBLE_DEVICES names them."""
    if device == "cpu":
        return []
    # Set by Slurm, for example: other GPUs belong to others.
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [name for name in given.split(",") if name]
    # Only now: it takes a second, and CPUs do not need it.
    import torch

    return [str(number) for number in range(torch.cuda.device_count())]


def _usable_cores() -> int:
    """CPU cores that this process may use; all of the machine where the system does not say."""
    # A container or Slurm may leave fewer than the machine has.
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
    return len(allowed) or os.cpu_count() or 1
