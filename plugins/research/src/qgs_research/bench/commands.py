"""Command `qgs bench`: size, latency and memory of models, as tables and a JSON report."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from qgs.cli.options import Device, Overrides, Size, Threads, parse_size, use_threads

app = typer.Typer(help="Measure speed, memory and size of models.")

InputViews = Annotated[
    int | None, typer.Option(min=1, help="Number of input photos. Default: that of the recipe.")
]
Precision = Annotated[
    Literal["float32", "bf16"], typer.Option(help="Use float32, or bf16 for autocast.")
]
Memory = Annotated[
    bool, typer.Option("--memory", help="Measure peak memory too, each time in a new process.")
]
Report = Annotated[
    Path | None, typer.Option(metavar="FILE", help="New file for a JSON report with all times.")
]


@app.command()
def bench(
    recipes: Annotated[
        list[Path], typer.Argument(help="Recipe files. Ratios are relative to the first recipe.")
    ],
    overrides: Overrides = None,
    views: InputViews = None,
    size: Size = None,
    batch: Annotated[int, typer.Option(min=1, help="Scenes per batch.")] = 1,
    precision: Precision = "float32",
    step: Annotated[bool, typer.Option("--step", help="Also measure training steps.")] = False,
    memory: Memory = False,
    renderer: Annotated[bool, typer.Option("--renderer", help="Also measure rendering.")] = False,
    rounds: Annotated[int, typer.Option(min=1, help="Measured calls of each operation.")] = 10,
    warmup: Annotated[int, typer.Option(min=0, help="Unmeasured calls at the start.")] = 2,
    json: Report = None,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Measure size, latency and memory of the models of one or more recipes.

    Weights and photos are random. Latency and FLOPs are from photos to Gaussians.
    """
    from rich.console import Console

    from qgs.evaluate.results import as_json
    from qgs.files import refuse_existing, write_text
    from qgs.train.distributed import choose_device
    from qgs_research.bench.output import show
    from qgs_research.bench.run import measure_recipes

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
