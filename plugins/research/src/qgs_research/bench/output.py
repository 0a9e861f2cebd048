"""Tables that `qgs bench` prints."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console

from qgs.terminal import print_table
from qgs_research import short_names

MEBIBYTE = 2**20
TITLES = {
    "forward": "photos to Gaussians",
    "render": "rendering the target views",
    "step": "training step",
}


def show(report: Mapping[str, Any], console: Console) -> None:
    """Print a table of the models, then a table for each measured quantity."""
    entries = report["recipes"]
    base = entries[0]
    of = "{device} ({processor}, {threads} threads), torch {torch}".format(**report["machine"])
    rounds = "{rounds} rounds after {warmup} of warm-up".format(**report)
    settings = f"{base['precision']}, {of}; {rounds}"
    console.print(f"{settings}; ratios are relative to the first recipe", markup=False)
    names = short_names([entry["recipe"] for entry in entries])

    def table(title: str, headers: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        lines = [[name, *row] for name, row in zip(names, rows, strict=True)]
        print_table(console, title, [["recipe", *headers], *lines])

    headers = ("V x H x W", "Gaussians", "parameters", "ratio", "weights, MiB")
    table(f"models, batch {base['batch']}", headers, map(_size_cells, entries))
    flops = [entry["flops"] for entry in entries]
    rows = [(f"{count / 1e9:,.3f}", f"{count / flops[0]:.3f}") for count in flops]
    table("operations, photos to Gaussians", ("GFLOP", "ratio"), rows)
    for operation, first in base["seconds"].items():
        # the first recipe sets the unit of all rows, so that they compare
        in_seconds = first["median"] >= 10
        unit = "s" if in_seconds else "ms"
        headers = (f"median, {unit}", "quartiles", "ratio, round by round", "quartiles")
        times = [entry["seconds"][operation] for entry in entries]
        scale = 1.0 if in_seconds else 1000.0
        rows = [(*_cells(found, scale), *_cells(found["ratio"], 1.0)) for found in times]
        table(TITLES[operation], headers, rows)
    for operation in base["memory"]:
        peaks = [entry["memory"][operation] for entry in entries]
        headers = ("peak, MiB", "before the model", "ratio")
        rows = [
            (
                f"{peak['peak_bytes'] / MEBIBYTE:,.1f}",
                f"{peak['idle_bytes'] / MEBIBYTE:,.1f}",
                f"{peak['ratio']:.3f}",
            )
            for peak in peaks
        ]
        table(f"memory: {TITLES[operation]}", headers, rows)


def _size_cells(entry: Mapping[str, Any]) -> tuple[str, ...]:
    parameters = entry["parameters"]
    return (
        " x ".join(map(str, (entry["views"], *entry["size"]))),
        f"{entry['gaussians']:,}" if entry["gaussians"] else "per view",
        f"{parameters['count']:,}",
        f"{parameters['ratio']:.3f}",
        f"{parameters['weight_bytes'] / MEBIBYTE:,.2f}",
    )


def _cells(found: Mapping[str, float], scale: float) -> tuple[str, str]:
    """Format a median, and the range from lower to upper quartile, with four digits."""
    shown = []
    for quartile in ("lower_quartile", "median", "upper_quartile"):
        value = found[quartile] * scale
        digits = max(0, 4 - len(str(int(value))))
        shown.append(f"{value:,.{digits}f}")
    lower, median, upper = shown
    return median, f"{lower} .. {upper}"
