"""`qgs bench`: size, latency and memory of models, as tables and as a JSON report."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from qgs.cli.options import Device, Overrides, Size, Threads, parse_size, use_threads

if TYPE_CHECKING:
    from qgs.engine.bench.run import Report, Spread
    from qgs.engine.bench.work import Operation

MEBIBYTE = 2**20
TITLES = {
    "forward": "photos to Gaussians",
    "render": "rendering the target views",
    "step": "training step",
}


def bench(
    recipes: Annotated[
        list[Path], typer.Argument(help="Recipe files; the first is what others are compared with.")
    ],
    overrides: Overrides = None,
    views: Annotated[
        int | None, typer.Option(min=1, help="Input views; as the recipe says if not given.")
    ] = None,
    size: Size = None,
    batch: Annotated[int, typer.Option(min=1, help="Scenes at once.")] = 1,
    precision: Annotated[str, typer.Option(help="float32 or bf16 (autocast).")] = "float32",
    step: Annotated[bool, typer.Option("--step", help="Training steps too.")] = False,
    memory: Annotated[
        bool, typer.Option("--memory", help="Peak memory too, of a fresh process each.")
    ] = False,
    renderer: Annotated[bool, typer.Option("--renderer", help="The renderer too.")] = False,
    rounds: Annotated[int, typer.Option(min=1, help="Samples of each latency.")] = 10,
    warmup: Annotated[int, typer.Option(min=0, help="Calls before the first sample.")] = 2,
    json: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a report with every sample.")
    ] = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Size and latency of models, any number of recipes in turn, as ratios to the first.

    Models have their initial weights, photos and poses are random: no data is needed. Latency is
    from photos to Gaussians, batch by batch. With --memory: on a CPU the peak resident set of a
    process, on a GPU what torch allocated at most.
    """
    from qgs.composer import resolve
    from qgs.engine.bench.run import Subject, refuse_other_file
    from qgs.engine.bench.run import bench as measure
    from qgs.engine.bench.work import workload_of
    from qgs.engine.distributed import choose_device

    if json is not None:
        refuse_other_file(json)
    if precision not in ("float32", "bf16"):
        raise ValueError(f"--precision must be float32 or bf16, got {precision!r}")
    work = {"views": views, "size": parse_size(size), "batch": batch, "precision": precision}
    use_threads(threads)
    console = Console()
    work["device"] = choose_device(device, console.print)
    resolved = [(str(path), resolve(path, overrides or ())) for path in recipes]
    subjects = [Subject(name, recipe, workload_of(recipe, **work)) for name, recipe in resolved]
    with console.status("composing") as status:
        report = measure(
            subjects,
            step=step,
            memory=memory,
            renderer=renderer,
            rounds=rounds,
            warmup=warmup,
            overrides=overrides or (),
            say=status.update,
        )
    console.print(_headline(report), markup=False)
    for table in _tables(report):
        console.print(table)
    if json is not None:
        report.write(json)
        console.print(f"written to {json}")


def _headline(report: Report) -> str:
    machine, work = report.machine, report.results[0].workload
    threads = "" if work.device == "cuda" else f", {machine['threads']} threads"
    return (
        f"{work.device} ({machine['processor']}{threads}), {work.precision}, "
        f"torch {machine['torch']}; {report.rounds} rounds after {report.warmup} of warm-up, "
        "ratios to the first recipe"
    )


def _tables(report: Report) -> list[Table]:
    """The models, then one table for each thing that was measured of them."""
    base = report.results[0]
    headers = ("V x H x W", "Gaussians", "parameters", "ratio", "weights, MiB")
    rows = [
        (
            " x ".join(map(str, (result.workload.views, *result.workload.size))),
            f"{result.gaussians:,}",
            f"{result.parameters:,}",
            f"{result.parameters / base.parameters:.3f}",
            f"{result.weight_bytes / MEBIBYTE:,.2f}",
        )
        for result in report.results
    ]
    tables = [_table(report, f"models, batch {base.workload.batch}", headers, rows)]
    tables += [_seconds(report, operation) for operation in base.times]
    return [*tables, *(_memory(report, operation) for operation in base.peaks)]


def _table(
    report: Report, title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]
) -> Table:
    """`rows` of numbers, each behind the name of its recipe."""
    table = Table(title=title, title_justify="left")
    table.add_column("recipe", overflow="fold")
    for header in headers:
        table.add_column(header, justify="right")
    names = short_names([result.recipe for result in report.results])
    for name, row in zip(names, rows, strict=True):
        table.add_row(escape(name), *row)
    return table


def short_names(paths: Sequence[str]) -> list[str]:
    """Paths without the folders that all of them share, and without their suffix.

    A path that comes again is numbered.
    """
    files = [Path(os.path.abspath(path)) for path in paths]
    shared = os.path.commonpath([file.parent for file in files])
    names = [file.relative_to(shared).with_suffix("").as_posix() for file in files]
    before = [names[:index].count(name) for index, name in enumerate(names)]
    return [f"{n} ({b + 1})" if b else n for n, b in zip(names, before, strict=True)]


def _seconds(report: Report, operation: Operation) -> Table:
    base = report.results[0].times[operation]
    unit, scale = ("s", 1.0) if base.quartiles[1] >= 10 else ("ms", 1000.0)
    headers = (f"median, {unit}", "quartiles", "ratio, round by round", "quartiles")
    times = [result.times[operation] for result in report.results]
    rows = [(*_cells(spread, scale), *_cells(spread.over(base), 1.0)) for spread in times]
    return _table(report, TITLES[operation], headers, rows)


def _memory(report: Report, operation: Operation) -> Table:
    base = report.results[0].peaks[operation].peak_bytes
    peaks = [result.peaks[operation] for result in report.results]
    rows = [
        (
            f"{peak.peak_bytes / MEBIBYTE:,.1f}",
            f"{peak.idle_bytes / MEBIBYTE:,.1f}",
            f"{peak.peak_bytes / base:.3f}",
        )
        for peak in peaks
    ]
    headers = ("peak, MiB", "before the model", "ratio")
    return _table(report, f"memory: {TITLES[operation]}", headers, rows)


def _cells(spread: Spread, scale: float) -> tuple[str, str]:
    """Median and quartiles, four digits each."""
    lower, median, upper = (
        f"{value:,.{max(0, 4 - len(str(int(value))))}f}"
        for value in (quartile * scale for quartile in spread.quartiles)
    )
    return median, f"{lower} .. {upper}"
