"""A report of `qgs bench` as tables."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from qgs.engine.bench.run import Report, Spread
from qgs.engine.bench.work import Operation

MEBIBYTE = 2**20
CALLED = {
    "forward": "photos to Gaussians",
    "render": "rendering the target views",
    "step": "training step",
}


def headline(report: Report) -> str:
    """What everything below was measured on."""
    machine, work = report.machine, report.results[0].workload
    threads = "" if work.device == "cuda" else f", {machine['threads']} threads"
    return (
        f"{work.device} ({machine['processor']}{threads}), {work.precision}, "
        f"torch {machine['torch']}; {report.rounds} rounds after {report.warmup} of warm-up, "
        "ratios to the first recipe"
    )


def bench_tables(report: Report) -> list[Table]:
    """The models, then one table for each thing that was measured of them."""
    names = short_names([result.recipe for result in report.results])
    base = report.results[0]
    tables = [_models(report, names)]
    tables += [_seconds(report, names, operation) for operation in base.times]
    return [*tables, *(_memory(report, names, operation) for operation in base.peaks)]


def short_names(paths: Sequence[str]) -> list[str]:
    """Paths without the folders that all of them share, and without their suffix.

    A path that comes again is numbered.
    """
    files = [Path(os.path.abspath(path)) for path in paths]
    shared = os.path.commonpath([file.parent for file in files])
    names = [file.relative_to(shared).with_suffix("").as_posix() for file in files]
    before = [names[:index].count(name) for index, name in enumerate(names)]
    return [f"{n} ({b + 1})" if b else n for n, b in zip(names, before, strict=True)]


def _table(title: str, headers: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("recipe", overflow="fold")
    for header in headers:
        table.add_column(header, justify="right")
    return table


def _models(report: Report, names: Sequence[str]) -> Table:
    headers = ("V x H x W", "Gaussians", "parameters", "ratio", "weights, MiB")
    table = _table(f"models, batch {report.results[0].workload.batch}", headers)
    base = report.results[0]
    for name, result in zip(names, report.results, strict=True):
        work = result.workload
        table.add_row(
            escape(name),
            " x ".join(map(str, (work.views, *work.size))),
            f"{result.gaussians:,}",
            f"{result.parameters:,}",
            f"{result.parameters / base.parameters:.3f}",
            f"{result.weight_bytes / MEBIBYTE:,.2f}",
        )
    return table


def _seconds(report: Report, names: Sequence[str], operation: Operation) -> Table:
    base = report.results[0].times[operation]
    unit, scale = ("s", 1.0) if base.quartiles[1] >= 10 else ("ms", 1000.0)
    headers = (f"median, {unit}", "quartiles", "ratio, round by round", "quartiles")
    table = _table(CALLED[operation], headers)
    for name, result in zip(names, report.results, strict=True):
        spread = result.times[operation]
        table.add_row(escape(name), *_cells(spread, scale), *_cells(spread.over(base), 1.0))
    return table


def _memory(report: Report, names: Sequence[str], operation: Operation) -> Table:
    base = report.results[0].peaks[operation].peak_bytes
    headers = ("peak, MiB", "before the model", "ratio")
    table = _table(f"memory: {CALLED[operation]}", headers)
    for name, result in zip(names, report.results, strict=True):
        peak = result.peaks[operation]
        mebibytes = (f"{x / MEBIBYTE:,.1f}" for x in (peak.peak_bytes, peak.idle_bytes))
        table.add_row(escape(name), *mebibytes, f"{peak.peak_bytes / base:.3f}")
    return table


def _cells(spread: Spread, scale: float) -> tuple[str, str]:
    lower, median, upper = (_four_digits(value * scale) for value in spread.quartiles)
    return median, f"{lower} .. {upper}"


def _four_digits(value: float) -> str:
    return f"{value:,.{max(0, 4 - len(str(int(value))))}f}"
