"""`qgs bench`: size, latency and memory of models, as tables and as a JSON report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias, get_args

import typer

from qgs.cli.options import Device, Overrides, Size, Threads, parse_size, use_threads

app = typer.Typer(help="How fast and how large models are.")

InputViews: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="Input views; default: the recipe's.")
]
Memory: TypeAlias = Annotated[
    bool, typer.Option("--memory", help="Peak memory too, of a fresh process each.")
]
Report: TypeAlias = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write a report with every sample, a new file.")
]


@app.command()
def bench(
    recipes: Annotated[list[Path], typer.Argument(help="Recipe files; the first is the measure.")],
    overrides: Overrides = None,
    views: InputViews = None,
    size: Size = None,
    batch: Annotated[int, typer.Option(min=1, help="Scenes at once.")] = 1,
    precision: Annotated[str, typer.Option(help="float32 or bf16 (autocast).")] = "float32",
    step: Annotated[bool, typer.Option("--step", help="Training steps too.")] = False,
    memory: Memory = False,
    renderer: Annotated[bool, typer.Option("--renderer", help="The renderer too.")] = False,
    rounds: Annotated[int, typer.Option(min=1, help="Samples of each latency.")] = 10,
    warmup: Annotated[int, typer.Option(min=0, help="Calls before the first sample.")] = 2,
    json: Report = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Size, latency and memory of models: any number of recipes in turn.

    Ratios are to the first. Weights, photos and poses are random: no data is needed.
    Latency and FLOPs are from photos to Gaussians. Memory: on a CPU a process's peak,
    on a GPU what torch allocated at most.
    """
    from rich.console import Console

    from qgs.evaluate.results import as_json
    from qgs.files import refuse_existing, write_text
    from qgs.precision import Precision
    from qgs.train.distributed import choose_device
    from qgs_research.bench.output import show
    from qgs_research.bench.run import measure_recipes

    known = get_args(Precision)
    if precision not in known:
        raise ValueError(f"--precision must be {' or '.join(known)}, got {precision!r}")
    use_threads(threads)
    if json is not None:
        refuse_existing(json)
    console = Console()
    work = {
        "views": views,
        "size": parse_size(size),
        "batch": batch,
        "precision": precision,
        "device": choose_device(device, console.print),
    }
    with console.status("composing") as status:
        report = measure_recipes(
            [*map(str, recipes)],
            work,
            step=step,
            memory=memory,
            renderer=renderer,
            rounds=rounds,
            warmup=warmup,
            overrides=overrides or (),
            say=status.update,
        )
    show(report, console)
    if json is not None:
        write_text(json, as_json(report))
