"""`qgs bench`: size, latency and memory of models, as tables and as a JSON report."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from qgs.cli.options import Device, Overrides, Size, Threads, parse_size, use_threads
from qgs.wording import counted, short_names

app = typer.Typer(help="How fast and how large models are.")

MEBIBYTE = 2**20
TITLES = {
    "forward": "photos to Gaussians",
    "render": "rendering the target views",
    "step": "training step",
}


@app.command()
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
    """Size, latency and memory of models: any number of recipes in turn.

    Ratios are to the first. Models have their initial weights, photos and poses
    are random: no data is needed. Latency is from photos to Gaussians, batch by
    batch. With --memory: on a CPU the peak resident set of a process, on a GPU
    what torch allocated at most.
    """
    from qgs.composer import resolve
    from qgs.engine.distributed import choose_device
    from qgs.engine.results import as_json
    from qgs.io.files import write_text
    from qgs_bench.run import Subject, refuse_other_file
    from qgs_bench.run import bench as measure
    from qgs_bench.work import workload_of

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
    options: dict[str, Any] = {"step": step, "memory": memory, "renderer": renderer}
    options |= {"rounds": rounds, "warmup": warmup, "overrides": overrides or ()}
    with console.status("composing") as status:
        report = measure(subjects, say=status.update, **options)
    _show(report, console)
    if json is not None:
        write_text(json, as_json(report))
        console.print(f"written to {json}")


def _show(report: dict[str, Any], console: Console) -> None:
    """The models, then one table for each thing that was measured of them."""
    from qgs.engine.results import print_table

    recipes, machine = report["recipes"], report["machine"]
    base = recipes[0]
    threads = "" if base["device"] == "cuda" else f", {counted(machine['threads'], 'thread')}"
    console.print(
        f"{base['device']} ({machine['processor']}{threads}), {base['precision']}, "
        f"torch {machine['torch']}; {report['rounds']} rounds after {report['warmup']} of warm-up, "
        "ratios to the first recipe",
        markup=False,
    )
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
