"""`qgs bench`: size, latency and memory of models, as tables and as a JSON report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from qgs.cli.options import Device, Overrides, Size, Threads, parse_size, use_threads

app = typer.Typer(help="How fast and how large models are.")


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
    batch: Annotated[
        int | None, typer.Option(min=1, help="Scenes at once; 1, of --predict the recipe's.")
    ] = None,
    precision: Annotated[
        str | None,
        typer.Option(help="float32 or bf16 (autocast); float32, of --predict the recipe's."),
    ] = None,
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
        bool, typer.Option("--predict", help="Whether a training would fit; nothing is run.")
    ] = False,
    within: Annotated[
        str | None,
        typer.Option(metavar="SIZE", help="Of --predict: memory, as 24GB; default: what is free."),
    ] = None,
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
    from qgs.engine.distributed import choose_device

    others = {"--step": step, "--memory": memory, "--renderer": renderer}
    _refuse_beside("--sweep", sweep, {"--memory": memory, "--renderer": renderer})
    _refuse_beside("--predict", predict, others | {"--sweep": sweep})
    if within is not None and not predict:
        raise ValueError("--within says of which memory --predict speaks; give --predict too")
    if precision not in (None, "float32", "bf16"):
        raise ValueError(f"--precision must be float32 or bf16, got {precision!r}")
    work = {"views": views, "size": parse_size(size), "batch": batch, "precision": precision}
    use_threads(threads)
    console = Console()
    call = _Call([str(path) for path in recipes], overrides or [], work, json, console)
    if predict:
        work["device"] = "cuda" if device == "cuda" else choose_device(device, console.print)
        return _predict(call, within)
    work |= {"batch": batch or 1, "precision": precision or "float32"}
    work["device"] = choose_device(device, console.print)
    options: dict[str, Any] = {"step": step, "rounds": rounds, "warmup": warmup}
    if sweep:
        return _sweep(call, sweep, **options)
    _compare(call, **options, memory=memory, renderer=renderer)


def _refuse_beside(option: str, given: object, others: dict[str, Any]) -> None:
    found = [name for name, value in others.items() if value]
    if given and found:
        raise ValueError(f"{option} stands alone; give {', '.join(found)} in a call of its own")


@dataclass(frozen=True)
class _Call:
    """What is measured and where the report goes. work: see `qgs_bench.work.workload_of`."""

    recipes: list[str]
    overrides: list[str]
    work: dict[str, Any]
    json: Path | None
    console: Console

    def refuse_other_file(self, *kind: str) -> None:
        """Refuse to replace a file that is no such report, before anything is measured."""
        from qgs_bench.run import refuse_other_file

        if self.json is not None:
            refuse_other_file(self.json, *kind)

    def write(self, report: dict[str, Any]) -> None:
        """Write the report where one is wanted."""
        from qgs.engine.results import as_json
        from qgs.io.files import write_text

        if self.json is not None:
            write_text(self.json, as_json(report))
            self.console.print(f"written to {self.json}")


def _compare(call: _Call, **options: Any) -> None:
    from qgs.composer import resolve
    from qgs_bench.output import show
    from qgs_bench.run import Subject, bench
    from qgs_bench.work import workload_of

    call.refuse_other_file()
    resolved = [(name, resolve(name, call.overrides)) for name in call.recipes]
    subjects = [
        Subject(name, recipe, workload_of(recipe, **call.work)) for name, recipe in resolved
    ]
    with call.console.status("composing") as status:
        report = bench(subjects, overrides=call.overrides, say=status.update, **options)
    show(report, call.console)
    call.write(report)


def _sweep(call: _Call, axes: list[str], **options: Any) -> None:
    from qgs_bench.output import refuse_other_files, show_sweep, write_sweep
    from qgs_bench.sweep import KIND, parse_axis, sweep

    parsed = [parse_axis(text) for text in axes]
    call.refuse_other_file(KIND)
    if call.json is not None:
        refuse_other_files(call.json)
    files: list[Path] = []

    def keep(report: dict[str, Any]) -> None:
        if call.json is not None:
            files[:] = write_sweep(report, call.json)

    given: dict[str, Any] = {"overrides": call.overrides, "keep": keep, **options}
    with call.console.status("composing") as status:
        report = sweep(call.recipes, parsed, call.work, say=status.update, **given)
    show_sweep(report, call.console)
    if files:
        call.console.print(f"written to {', '.join(map(str, files))}")
    if not any(series["points"] for series in report["series"]):
        raise ValueError("no point of the sweep could be measured; the reasons are above")


def _predict(call: _Call, within: str | None) -> None:
    from qgs.composer import resolve
    from qgs_bench.output import show_prediction
    from qgs_bench.predict import KIND, available, parse_bytes, predict
    from qgs_bench.work import workload_of

    call.refuse_other_file(KIND)
    work, console = call.work, call.console
    limit = available(work["device"]) if within is None else parse_bytes(within)
    report: dict[str, Any] = {"report": KIND, "overrides": call.overrides, "limit_bytes": limit}
    report["recipes"] = []
    for name in call.recipes:
        recipe = resolve(name, call.overrides)
        config = recipe.training
        batch, precision = work["batch"] or config.batch_size, work["precision"] or config.precision
        workload = workload_of(recipe, **{**work, "batch": batch, "precision": precision})
        with console.status(f"counting {name}"):
            found = {"recipe": name, **predict(recipe, workload, limit)}
        report["recipes"].append(found)
        show_prediction(found, limit, console)
    call.write(report)
