"""`qgs import` and `qgs export`: published weights in and out."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from qgs.cli.options import Checkpoint, Overrides


class Layout(StrEnum):
    """Layouts of a state dict besides our own."""

    published = "published"


def import_(
    weights: Annotated[
        Path, typer.Argument(help="Published weights: .safetensors, or .pt .pth .bin .ckpt.")
    ],
    recipe: Annotated[
        str, typer.Option(help="Recipe file whose model they are; auto for the one that fits.")
    ],
    out: Annotated[Path, typer.Option(help="New checkpoint; never overwritten.")],
    overrides: Overrides = None,
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
    name = done.layout.name
    lines = [*done.notes, f"{name} ({done.layout.source}): {done.count} tensors used"]
    if done.unused:
        lines.append(f"knowingly dropped, {name} never reads these {len(done.unused)}:")
        lines += [f"  {tensor}" for tensor in done.unused]
    if done.settings:
        lines.append(f"the recipe differs from {name} in options that no weight shows:")
        lines += [f"  {setting}" for setting in done.settings]
    lines.append(f"wrote {out}")
    if done.recipe_file:
        lines.append(f"wrote {done.recipe_file}; names and shapes could not tell:")
        lines += [f"  {choice}" for choice in done.layout.undecided]
    typer.echo("\n".join(lines))


def export(
    checkpoint: Checkpoint,
    out: Annotated[Path, typer.Option(help="New .safetensors file; never overwritten.")],
    layout: Annotated[
        Layout | None, typer.Option(help="Whose names the weights get; a file for other code.")
    ] = None,
    half: Annotated[
        bool, typer.Option("--half", help="A checkpoint with weights of half precision.")
    ] = False,
) -> None:
    """Write a checkpoint's weights as the published code names them, or at half the size."""
    from qgs.engine.folder import checkpoint_of
    from qgs.io.transfer import export_half, export_weights

    if half == (layout is not None):
        raise ValueError("give one of --layout published and --half")
    if half:
        export_half(checkpoint_of(checkpoint), out)
        typer.echo(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB; qgs.load gives float32")
        return
    done = export_weights(checkpoint_of(checkpoint), out)
    name = done.layout.name
    lines = [f"{name} ({done.layout.source}): {done.count} tensors written"]
    if done.settings:
        lines.append("the file does not carry these options; its reader must be given them:")
        lines += [f"  {setting}" for setting in done.settings]
    if done.unused:
        lines.append(
            f"{name} also stores {len(done.unused)} tensors that it never reads; they are absent, "
            "so load with strict=False and expect exactly these to be missing:"
        )
        lines += [f"  {tensor}" for tensor in done.unused]
    typer.echo("\n".join([*lines, f"wrote {out}"]))
