"""Options that several commands share."""

import re
from typing import Annotated, TypeAlias

import typer

Checkpoint: TypeAlias = Annotated[
    str, typer.Argument(help="Run folder, checkpoint, its URL, or a shipped model: PLUGIN/NAME.")
]
Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change an option of the recipe, such as model.queries.count=128."),
]
Threads: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="CPU threads. Default: all cores.")
]
Device: TypeAlias = Annotated[
    str, typer.Option(help="auto, cpu or cuda. auto uses CUDA if gsplat is installed.")
]
Size: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="HxW",
        help="Height and width of the photos. Default: whole photos, the shorter side from the "
        "recipe's data.image_size.",
    ),
]
Inputs: TypeAlias = Annotated[
    int | None, typer.Option(min=1, help="Number of input views. Default: the recipe's.")
]
Frames: TypeAlias = Annotated[
    str | None,
    typer.Option(help="Input photos by number or name: 0,8,x.jpg. Default: chosen by qgs."),
]
SceneName: TypeAlias = Annotated[
    str | None, typer.Option("--scene", help="Scene to use, if there are several.")
]
ViewsSettings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change an option of the recipe's `views`. Repeatable."),
]
Scale: TypeAlias = Annotated[
    float | None,
    typer.Option(
        help="Scale of the cameras' positions. Default: search for the scale at which the model "
        "renders your photos best."
    ),
]
Tune: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="[WHAT:]STEPS",
        help="Fit the queries to the input photos first, for STEPS steps; latents:STEPS fits the "
        "photos' features instead. 0: no fitting.",
    ),
]


def scale_settings(scale: float | None) -> list[str]:
    """Return the settings of --scale. Raises ValueError for a factor that is not above 0."""
    if scale is None:
        return []
    if not 0 < scale < float("inf"):
        raise ValueError(f"--scale must be a factor above 0, such as 0.4, got {scale:g}")
    return ["views.scale=constant", f"views.scale_factor={scale}"]


def use_threads(threads: int | None) -> None:
    """Compute on that many CPU threads; None leaves torch's choice."""
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Return (H, W) of "HxW"; raises ValueError for anything else."""
    if text is None:
        return None
    # Height first, as in recipes and tensors.
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if match is None:
        raise ValueError(f"--size must be HxW in pixels, such as 256x448, got {text!r}")
    return int(match[1]), int(match[2])
