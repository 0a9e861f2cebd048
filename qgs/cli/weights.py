"""`qgs import` and `qgs export`: published weights in and out."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Layout(StrEnum):
    """Layouts of a state dict besides our own."""

    published = "published"


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("import")(import_)
    app.command("export")(export)


def import_(
    weights: Annotated[
        Path, typer.Argument(help="Published weights: .safetensors, or .pt .pth .bin .ckpt.")
    ],
    recipe: Annotated[
        str, typer.Option(help="Recipe file whose model they are; auto for the one that fits.")
    ],
    out: Annotated[Path, typer.Option(help="New checkpoint; never overwritten.")],
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override, such as model.head.scale_cap=0.1; repeatable."),
    ] = None,
    to_float32: Annotated[
        bool,
        typer.Option("--to-float32", help="Convert other precisions instead of refusing them."),
    ] = False,
) -> None:
    """Turn published weights into a checkpoint; every tensor is accounted for.

    With `--recipe auto` the recipe that fits, after every --set, is written beside the checkpoint,
    as .yaml. A recipe without data knows no image size: give `--set data.type=qgs/photos --set
    data.path=PHOTOS --set data.image_size=[256,256]`, or `qgs reconstruct --size`.
    """
    from qgs.composer import resolve
    from qgs.io.transfer import import_weights

    resolved = None if recipe == "auto" else resolve(recipe, overrides or ())
    done = import_weights(weights, resolved, out, overrides=overrides or (), to_float32=to_float32)
    _lines(done.notes)
    typer.echo(f"{done.layout.name} ({done.layout.source}): {done.used} tensors used")
    if done.dropped:
        typer.echo(f"knowingly dropped, {done.layout.name} never reads these {len(done.dropped)}:")
        _lines(f"  {name}" for name in done.dropped)
    if done.settings:
        typer.echo(f"the recipe differs from {done.layout.name} in options that no weight shows:")
        _lines(f"  {setting}" for setting in done.settings)
    typer.echo(f"wrote {out}")
    if done.recipe_file:
        typer.echo(f"wrote {done.recipe_file}; names and shapes could not tell:")
        _lines(f"  {choice}" for choice in done.layout.undecided)


def export(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint, or the folder of a run.")],
    out: Annotated[Path, typer.Option(help="New .safetensors file; never overwritten.")],
    layout: Annotated[Layout, typer.Option(help="Whose names the weights get.")],
) -> None:
    """Write a checkpoint's weights as the published code names them."""
    from qgs.engine.folder import checkpoint_of
    from qgs.io.transfer import export_weights

    done = export_weights(checkpoint_of(checkpoint), out)
    typer.echo(f"{done.layout.name} ({done.layout.source}): {done.written} tensors written")
    if done.settings:
        typer.echo("the file does not carry these options; its reader must be given them:")
        _lines(f"  {setting}" for setting in done.settings)
    if done.absent:
        typer.echo(
            f"{done.layout.name} also stores {len(done.absent)} tensors that it never reads; they "
            "are absent, so load with strict=False and expect exactly these to be missing:"
        )
        _lines(f"  {name}" for name in done.absent)
    typer.echo(f"wrote {out}")


def _lines(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)
