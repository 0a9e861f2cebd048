"""`qgs reconstruct`: from a checkpoint and a folder of photos to Gaussians and pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from qgs.analysis.reconstruction import Reconstruction
    from qgs.composer import Recipe
    from qgs.data.photos import PhotosConfig


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("reconstruct")(reconstruct)


def reconstruct(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint file, or the run folder.")],
    photos: Annotated[Path, typer.Argument(help="Folder with a transforms.json.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    inputs: Annotated[
        int | None, typer.Option(min=1, help="Number of input views; default: the recipe's.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Input frames, such as 0,8,16; default: spread mid-folder.")
    ] = None,
    holdout: Annotated[
        str | None,
        typer.Option(help="Frames to compare with; default: six between the inputs."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that is not empty.")
    ] = False,
) -> None:
    """Reconstruct a scene: PLY, renders beside photos, depth, an orbit, cameras."""
    check_out(out, overwrite)
    chosen = frame_list(frames, "--frames")
    compared = frame_list(holdout, "--holdout")

    import torch
    from rich.console import Console

    from qgs.analysis.frames import choose_frames
    from qgs.analysis.reconstruction import reconstruct as run
    from qgs.analysis.reconstruction import write_reconstruction
    from qgs.data.photos import PhotosSource
    from qgs.data.sampling import make_sample
    from qgs.engine.folder import checkpoint_of
    from qgs.io.checkpoint import load, load_recipe

    device = "cuda" if torch.cuda.is_available() else "cpu"
    file = checkpoint_of(checkpoint)
    model, recipe = load(file, device), load_recipe(file)
    (scene,) = PhotosSource(photos_config(recipe, photos)).scenes("test")
    wanted = inputs or recipe.views.inputs
    span = recipe.views.gap[1] + 1
    picked = choose_frames(len(scene), wanted, span, chosen, compared)
    sample = make_sample(scene, *picked, recipe.views, mirror=False)
    sample = replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
    result = run(model, sample)
    console = Console()
    console.print(score_table(result))
    for path in write_reconstruction(model, result, out):
        console.print(f"wrote {path}", soft_wrap=True)


def photos_config(recipe: Recipe, photos: Path) -> PhotosConfig:
    """How to read `photos` for a model of `recipe`: at the image size that it was trained on.

    Raises ValueError for a recipe without data, which has no image size.
    """
    from qgs.contracts import SceneSourceConfig
    from qgs.data.photos import PhotosConfig

    if ("data",) not in recipe.parts:
        raise ValueError("the checkpoint's recipe has no data, so its image size is not known")
    trained = recipe.parts["data",].config
    assert isinstance(trained, SceneSourceConfig)
    if isinstance(trained, PhotosConfig):
        every = {"path": str(photos), "holdout": 0, "max_frames": 0}
        return trained.model_copy(update=every)
    return PhotosConfig(path=str(photos), image_size=trained.image_size, holdout=0)


def check_out(out: Path, overwrite: bool) -> None:
    """Raise FileExistsError when `out` is a file, or holds something that is not to be replaced."""
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for --out")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise FileExistsError(
            f"{out} is not empty; choose another --out, or add --overwrite to replace the files "
            "of the same names"
        )


def frame_list(text: str | None, option: str) -> list[int] | None:
    """Frame numbers of "0,8,16"; None stays None. Raises ValueError for anything else."""
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(
            f"{option} takes frame numbers with commas between, such as 0,8,16; got {text!r}"
        ) from None


def score_table(result: Reconstruction) -> Table:
    """PSNR of every rendered view, inputs first, and the means of both kinds."""
    from rich.table import Table

    table = Table(title=f"{result.sample.scene}: {result.gaussians.count:,} Gaussians")
    table.add_column("view")
    table.add_column("frames", justify="right")
    table.add_column("PSNR", justify="right")
    for kind, is_input in (("input", True), ("novel", False)):
        scores = [score for score in result.scores if score.is_input == is_input]
        for score in scores:
            table.add_row(kind, str(score.frame), f"{score.psnr:.2f}")
        if scores:
            mean = sum(score.psnr for score in scores) / len(scores)
            table.add_row(f"{kind}, mean", str(len(scores)), f"{mean:.2f}", style="bold")
            table.add_section()
    return table
