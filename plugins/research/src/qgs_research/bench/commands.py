"""`qgs bench`: size, latency and memory of models, as tables and as a JSON report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from qgs.cli.options import Device, Overrides, Size, Threads, parse_size, use_threads

app = typer.Typer(help="How fast and how large models are.")


@app.command()
def bench(
    recipes: Annotated[
        list[Path], typer.Argument(help="Recipe files; ratios are to the first one.")
    ],
    overrides: Overrides = None,
    views: Annotated[
        int | None, typer.Option(min=1, help="Input views; default: the recipe's.")
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
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AXIS=A..B",
            help="Time and memory at A, 2 A, ... up to B, of views, queries, size or batch.",
        ),
    ] = None,
    predict: Annotated[
        bool, typer.Option("--predict", help="Memory and time on this CPU, without running.")
    ] = False,
    within: Annotated[
        float, typer.Option(metavar="GB", min=0, help="With --predict: does a step fit?")
    ] = 0,
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
    from rich.console import Console

    from qgs.train.distributed import choose_device
    from qgs_research.bench.output import refuse_other_file, show, show_sweep, write, write_sweep
    from qgs_research.bench.run import measure_recipes
    from qgs_research.bench.sweep import measure_sweep, parse_axis

    if sweep and (memory or renderer):
        raise ValueError("--sweep measures memory itself and no renderer: give neither option")
    if within and not predict:
        raise ValueError("--within belongs to --predict: give both")
    if precision not in ("float32", "bf16"):
        raise ValueError(f"--precision must be float32 or bf16, got {precision!r}")
    axes = [parse_axis(text) for text in sweep or ()]
    use_threads(threads)
    console = Console()
    work: dict[str, Any] = {
        "views": views,
        "size": parse_size(size),
        "batch": batch,
        "precision": precision,
        "device": choose_device(device, console.print),
    }
    names = [str(path) for path in recipes]
    if predict:
        if work["device"] != "cpu":
            raise ValueError("--predict predicts the CPU: add --device cpu")
        from qgs_research.bench.predict import predict_recipes, show_predictions

        with console.status("calibrating") as status:
            entries = predict_recipes(names, work, overrides or (), status.update)
        return show_predictions(entries, console, within)
    options: dict[str, Any] = {"overrides": overrides or [], "rounds": rounds, "warmup": warmup}
    files: list[Path] = []
    if json is not None:
        refuse_other_file(json)
    with console.status("composing") as status:
        options |= {"step": step, "say": status.update}
        if axes:
            # A sweep takes hours: its files are written after every point.
            def keep(report: dict[str, Any]) -> None:
                files[:] = [] if json is None else write_sweep(report, json)

            report = measure_sweep(names, axes, work, keep=keep, **options)
        else:
            report = measure_recipes(names, work, memory=memory, renderer=renderer, **options)
            files = [] if json is None else [write(report, json)]
    (show_sweep if axes else show)(report, console)
    if files:
        console.print(f"written to {', '.join(map(str, files))}")
    if axes and not report["points"]:
        raise ValueError("no point of the sweep could be measured; the reasons are above")
