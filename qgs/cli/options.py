"""Options that several commands share."""

import re
from typing import Annotated

import typer

Checkpoint = Annotated[
    str,
    typer.Argument(
        help="Run folder, checkpoint file, URL of a checkpoint, or model of a plug-in: PLUGIN/NAME."
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Change an option of the recipe, such as model.queries.count=128. Repeatable."
    ),
]
Threads = Annotated[
    int | None, typer.Option(min=1, help="Number of CPU threads. Default: all cores.")
]
Device = Annotated[
    str,
    typer.Option(
        help="Device: auto, cpu or cuda. auto is cuda if there is a GPU and gsplat is installed, "
        "else cpu."
    ),
]
Size = Annotated[
    str | None,
    typer.Option(
        metavar="HxW",
        help="Height and width to which photos are cropped and resized. Default: photos are not "
        "cropped; the shorter side gets the length of training, and models of 128 pixels and more "
        "try 256 pixels too.",
    ),
]
Inputs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of input views. Default: as in the recipe, and one more if it is between two.",
    ),
]
Gaussians = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="About how many Gaussians the model makes, if it was trained with random numbers of "
        "queries (option `least` of landmark/observed). Default: as in the recipe.",
    ),
]
Frames = Annotated[
    str | None,
    typer.Option(help="Numbers or file names of input photos: 0,8,x.jpg. Default: qgs chooses."),
]
SceneName = Annotated[
    str | None, typer.Option("--scene", help="Scene to use, by name. Needed if there are several.")
]
ViewsSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Change an option in the recipe's section `views`, such as views.scale=auto. "
        "Repeatable.",
    ),
]
Scale = Annotated[
    float | None,
    typer.Option(
        help="Factor for all camera positions. Default: search for the factor with which the model "
        "renders your photos best."
    ),
]
Tune = Annotated[
    str | None,
    typer.Option(
        metavar="[WHAT:]STEPS",
        help="Fit WHAT to the input photos for STEPS steps before rendering. WHAT is queries or "
        "latents (encoder features). 0: no fitting. Default: as in the recipe for eval, else 0.",
    ),
]


def scale_settings(scale: float | None) -> list[str]:
    """Return recipe overrides for --scale; raise ValueError unless `scale` is None or positive."""
    if scale is None:
        return []
    if not 0 < scale < float("inf"):
        raise ValueError(f"--scale must be a positive factor, such as 0.4, got {scale:g}")
    return ["views.scale=constant", f"views.scale_factor={scale}"]


def use_threads(threads: int | None) -> None:
    """Let torch use this number of CPU threads; None keeps torch's default."""
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Return (H, W) in pixels for the text "HxW", None for None. Other text raises ValueError."""
    if text is None:
        return None
    # Height first, as in recipes and tensors.
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if match is None:
        raise ValueError(f"--size must be HxW in pixels, such as 256x448, got {text!r}")
    return int(match[1]), int(match[2])
