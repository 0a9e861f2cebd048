"""`qgs bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Device, Overrides, Threads, parse_size, use_threads


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("bench")(bench)


def bench(
    recipes: Annotated[
        list[Path], typer.Argument(help="Recipe files; the first is what others are compared with.")
    ],
    overrides: Overrides = None,
    views: Annotated[
        int | None, typer.Option(min=1, help="Input views; as the recipe says if not given.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="HxW", help="Height and width of the photos; the recipe's data.image_size."
        ),
    ] = None,
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
    from rich.console import Console

    from qgs.cli.bench_tables import bench_tables, headline
    from qgs.composer import resolve
    from qgs.engine.bench.run import Subject, refuse_other_file
    from qgs.engine.bench.run import bench as measure
    from qgs.engine.bench.work import workload_of
    from qgs.engine.distributed import choose_device

    if json is not None:
        refuse_other_file(json)
    if precision not in ("float32", "bf16"):
        raise ValueError(f"--precision must be float32 or bf16, got {precision!r}")
    pixels = parse_size(size)
    use_threads(threads)
    console = Console()
    work = {"views": views, "size": pixels, "batch": batch, "precision": precision}
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
    console.print(headline(report), markup=False)
    for table in bench_tables(report):
        console.print(table)
    if json is not None:
        report.write(json)
        console.print(f"written to {json}")
