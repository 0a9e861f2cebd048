"""Tables of what was measured, and the files of a report."""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from qgs.evaluate.results import as_json, print_lines, print_table
from qgs.files import replacing, write_text
from qgs.wording import counted, short_names
from qgs_research.bench.run import KIND
from qgs_research.bench.sweep import series_of

MEBIBYTE = 2**20
TITLES = {
    "forward": "photos to Gaussians",
    "render": "rendering the target views",
    "step": "training step",
}
SUFFIXES = (".csv", ".png", ".pdf")
"""Of the files beside the JSON report of a sweep."""


def show(report: dict[str, Any], console: Console) -> None:
    """The models, then one table for each thing that was measured of them."""
    recipes = report["recipes"]
    base, conditions = recipes[0], _conditions(report)
    console.print(f"{base['precision']}, {conditions}, ratios to the first recipe", markup=False)
    names = [escape(name) for name in short_names([recipe["recipe"] for recipe in recipes])]

    def table(title: str, headers: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        lines = [[name, *row] for name, row in zip(names, rows, strict=True)]
        print_table(console, title, [["recipe", *headers], *lines])

    headers = ("V x H x W", "Gaussians", "parameters", "ratio", "weights, MiB")
    rows = [
        (
            " x ".join(map(str, (recipe["views"], *recipe["size"]))),
            f"{recipe['gaussians']:,}" if recipe["gaussians"] else "by the views",
            f"{recipe['parameters']['count']:,}",
            f"{recipe['parameters']['ratio']:.3f}",
            f"{recipe['parameters']['weight_bytes'] / MEBIBYTE:,.2f}",
        )
        for recipe in recipes
    ]
    table(f"models, batch {base['batch']}", headers, rows)
    for operation, first in base["seconds"].items():
        unit, scale = ("s", 1.0) if first["median"] >= 10 else ("ms", 1000.0)
        headers = (f"median, {unit}", "quartiles", "ratio, round by round", "quartiles")
        times = [recipe["seconds"][operation] for recipe in recipes]
        rows = [(*_cells(found, scale), *_cells(found["ratio"], 1.0)) for found in times]
        table(TITLES[operation], headers, rows)
    for operation in base["memory"]:
        peaks = [recipe["memory"][operation] for recipe in recipes]
        sizes = [[f"{p[k] / MEBIBYTE:,.1f}" for k in ("peak_bytes", "idle_bytes")] for p in peaks]
        rows = [(*size, f"{p['ratio']:.3f}") for size, p in zip(sizes, peaks, strict=True)]
        table(f"memory: {TITLES[operation]}", ("peak, MiB", "before the model", "ratio"), rows)


def _cells(found: Mapping[str, float], scale: float) -> tuple[str, str]:
    """Median and quartiles, four digits each."""
    lower, median, upper = (
        f"{value:,.{max(0, 4 - len(str(int(value))))}f}"
        for value in (found[k] * scale for k in ("lower_quartile", "median", "upper_quartile"))
    )
    return median, f"{lower} .. {upper}"


def _conditions(report: Mapping[str, Any]) -> str:
    """Machine and rounds."""
    machine = report["machine"]
    threads = "" if machine["device"] == "cuda" else f", {counted(machine['threads'], 'thread')}"
    return (
        f"{machine['device']} ({machine['processor']}{threads}), torch {machine['torch']}; "
        f"{report['rounds']} rounds after {report['warmup']} of warm-up"
    )


def show_sweep(report: Mapping[str, Any], console: Console) -> None:
    """A table for each recipe, axis and operation, its exponents, and what failed."""
    console.print(_conditions(report), markup=False)
    series = series_of(report["points"])
    recipes = [*dict.fromkeys(recipe for recipe, _, _ in series)]
    short = dict(zip(recipes, short_names(recipes), strict=True)) if recipes else {}
    for fits, points in zip(report["fits"], series.values(), strict=True):
        rows = [[fits["axis"], "median, ms", "quartiles", "process, MiB"]]
        for point in points:
            own = point["memory"]["peak_bytes"] - point["memory"]["idle_bytes"]
            times = _cells(point["seconds"], 1000.0)
            rows.append([str(point["value"]), *times, f"{own / MEBIBYTE:,.1f}"])
        title = f"{short[fits['recipe']]}: {TITLES[fits['operation']]}, by {fits['axis']}"
        print_table(console, title, rows)
        words = {"seconds": "time", "bytes": "memory"}
        found = [f"{words[k]} {_exponent(fits[k])}" for k in words if fits[k]]
        print_lines(console, [f"exponents: {'; '.join(found)}"] * bool(found))
    for one in report["failed"]:
        what = f"{one['recipe']}, {one['operation']}, {one['axis']} {one['value']}"
        print_lines(console, [f"failed: {what}: {one['reason']}"])


def _exponent(fit: Mapping[str, Any]) -> str:
    error = "" if fit["error"] is None else f" +- {fit['error']:.2f}"
    return f"{fit['exponent']:.2f}{error} (last doubling {fit['last']:.2f})"


def refuse_other_file(path: Path) -> None:
    """Raise FileExistsError when `path` holds anything but an earlier report."""
    if not path.exists():
        return
    try:
        is_report = json.loads(path.read_text(encoding="utf-8"))["report"] == KIND
    except (OSError, ValueError, TypeError, KeyError):
        is_report = False
    if not is_report:
        raise FileExistsError(
            f"{path} exists and is no report of `{KIND}`; choose another name for the report"
        )


def write(report: Mapping[str, Any], path: Path) -> Path:
    """Write the report as JSON."""
    write_text(path, as_json(report))
    return path


def write_sweep(report: Mapping[str, Any], path: Path) -> list[Path]:
    """The report as JSON at `path`, and beside it as CSV, PNG and PDF."""
    from qgs_research.bench.figure import sweep_figure  # Matplotlib is slow to import

    files = [write(report, path), *(path.with_suffix(suffix) for suffix in SUFFIXES)]
    text = io.StringIO()
    names = ("recipe", "axis", "value", "operation")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*names, "seconds", "peak_bytes", "idle_bytes"))
    for point in report["points"]:
        costs = point["seconds"]["median"], *point["memory"].values()
        writer.writerow((*(point[name] for name in names), *costs))
    write_text(files[1], text.getvalue())
    figure = sweep_figure(report)
    for file in files[2:]:
        metadata = {"CreationDate": None} if file.suffix == ".pdf" else None
        with replacing(file) as place:
            figure.savefig(place, format=file.suffix[1:], dpi=160, metadata=metadata)
    return files
