"""Tables of what was measured, grown or predicted, and the files of a sweep."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from qgs.engine.results import as_json, print_lines, print_table
from qgs.io.files import replacing, write_text
from qgs.memory import in_words
from qgs.wording import counted, short_names
from qgs_bench.figure import sweep_figure
from qgs_bench.sweep import as_csv

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
    recipes, machine = report["recipes"], report["machine"]
    base = recipes[0]
    told = _told(machine, report)
    console.print(f"{base['precision']}, {told}, ratios to the first recipe", markup=False)
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


def _told(machine: Mapping[str, Any], report: Mapping[str, Any]) -> str:
    """Machine and rounds, in words."""
    device = machine["device"]
    threads = "" if device == "cuda" else f", {counted(machine['threads'], 'thread')}"
    return (
        f"{device} ({machine['processor']}{threads}), torch {machine['torch']}; "
        f"{report['rounds']} rounds after {report['warmup']} of warm-up"
    )


def show_sweep(report: Mapping[str, Any], console: Console) -> None:
    """A table for each series, its exponents, and what was left out or failed."""
    console.print(_told(report["machine"], report), markup=False)
    names = short_names([*dict.fromkeys(s["recipe"] for s in report["series"])])
    short = dict(zip(dict.fromkeys(s["recipe"] for s in report["series"]), names, strict=True))
    for series in report["series"]:
        rows = [[series["axis"], "median, ms", "quartiles", "tensors, MiB", "process, MiB"]]
        for point in series["points"]:
            memory, seconds = point["memory"], point["seconds"]
            own = memory["peak_bytes"] - memory["idle_bytes"]
            sizes = [f"{size / MEBIBYTE:,.1f}" for size in (point["counted_bytes"], own)]
            rows.append([str(point["value"]), *_cells(seconds, 1000.0), *sizes])
        title = f"{short[series['recipe']]}: {TITLES[series['operation']]}, by {series['axis']}"
        print_table(console, title, rows)
        fits = series["fits"]
        words = {"seconds": "time", "counted_bytes": "tensors", "peak_bytes": "process"}
        told = [f"{words[k]} {_exponent(fits[k])}" for k in words if fits[k]]
        missing = [
            f"{kind.replace('_', ' ')}: {series['axis']} {m['value']} {m['reason']}"
            for kind in ("left_out", "failed")
            for m in series[kind]
        ]
        print_lines(console, [f"exponents: {'; '.join(told)}"] * bool(told) + missing)


def _exponent(fit: Mapping[str, Any]) -> str:
    error = "" if fit["error"] is None else f" +- {fit['error']:.2f}"
    return f"{fit['exponent']:.2f}{error} (last doubling {fit['last']:.2f})"


def refuse_other_files(path: Path) -> None:
    """Raise FileExistsError where a file stands beside a sweep's report that is not its own."""
    beside = [path.with_suffix(suffix) for suffix in SUFFIXES]
    taken = [file.name for file in beside if file.exists()]
    if taken and not path.exists():
        raise FileExistsError(
            f"{', '.join(taken)} in {path.parent} would be written beside {path.name} and are of "
            "no earlier report; choose another name for the report"
        )


def write_sweep(report: Mapping[str, Any], path: Path) -> list[Path]:
    """The report as JSON at `path`, and beside it as CSV, PNG and PDF."""
    files = [path, *(path.with_suffix(suffix) for suffix in SUFFIXES)]
    write_text(path, as_json(report))
    write_text(files[1], as_csv(report))
    figure = sweep_figure(report)
    for file in files[2:]:
        metadata = {"CreationDate": None} if file.suffix == ".pdf" else None
        with replacing(file) as place:
            figure.savefig(place, format=file.suffix[1:], dpi=160, metadata=metadata)
    return files


def show_prediction(found: Mapping[str, Any], limit: int, console: Console) -> None:
    """What a training takes, by what for, whether it fits into `limit` bytes, and which batch."""
    rows = [["", "bytes"]]
    rows += [[what, in_words(n)] for what, n in (*found["step"].items(), *found["besides"].items())]
    rows.append(["all", in_words(found["total_bytes"])])
    size = " x ".join(map(str, (found["batch"], found["views"], *found["size"])))
    device, precision = found["device"], found["precision"]
    title = f"{found['recipe']}: training, B x V x H x W {size}, {precision}, on {device}"
    print_table(console, title, rows)
    kept = [f"{what} {in_words(size)}" for what, size in found["kept"].items() if size]
    lines = [f"kept for the backward pass: {', '.join(kept)}"] if kept else []
    fits, most = "fits" if found["fits"] else "does not fit", found["largest_batch"]
    batches = f"the largest batch that does is {most}" if most else "not even a batch of 1 does"
    print_lines(console, [*lines, f"{fits} into {in_words(limit)} on {device}; {batches}"])
