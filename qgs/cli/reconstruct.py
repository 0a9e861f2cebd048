"""`qgs reconstruct`: from a checkpoint and a folder of photos to Gaussians and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from qgs.cli.options import Device, parse_size

if TYPE_CHECKING:
    from qgs.composer import Recipe
    from qgs.contracts import Scene, SceneSource, Split

_SHOWN = 8


def chosen_scene(
    recipe: Recipe, path: str, size: tuple[int, int] | None, name: str | None
) -> tuple[Scene, Sequence[int]]:
    """The scene called `name` at `path`, or the only one, and the frames a model was trained on.

    Photos, chunks and DL3DV's archives are recognised by their content. Raises ValueError when
    there are several scenes and none is named, or none has the name.
    """
    from qgs.data.sampling import training_frames

    source, trained = opened_source(recipe, path, size)
    scene = scene_of(source, path, name)
    seen = training_frames(scene) if trained and scene.name in source.names("train") else ()
    return scene, seen


def opened_source(
    recipe: Recipe, path: str, size: tuple[int, int] | None
) -> tuple[SceneSource, bool]:
    """The data set at `path` at the recipe's image size, and whether it is what it was trained on.

    Held-out frames are kept when it is.
    """
    from qgs.data import ChunksSource, Dl3dvSource, PhotosSource
    from qgs.data.chunks.source import ChunksConfig
    from qgs.data.dl3dv import Dl3dvConfig
    from qgs.data.paths import opened_path
    from qgs.data.recognition import recognised

    root = opened_path(path)
    kind = recognised(root) if root.exists() else "qgs/photos"
    config = photos_config(recipe, path, size)
    if kind == "qgs/photos":
        return PhotosSource(config), was_trained_on(recipe, path)
    data = recipe.parts["data",].config if ("data",) in recipe.parts else None
    if (
        isinstance(data, ChunksConfig | Dl3dvConfig)
        and opened_path(data.path).resolve() == root.resolve()
    ):
        trained = data.model_copy(update={"image_size": config.image_size})
        if isinstance(trained, ChunksConfig):
            return ChunksSource(trained), True
        return Dl3dvSource(trained), True
    options = {"path": path, "image_size": config.image_size, "background": config.background}
    if kind == "qgs/chunks":
        return ChunksSource(ChunksConfig.model_validate(options)), False
    return Dl3dvSource(Dl3dvConfig.model_validate(options)), False


def scene_of(source: SceneSource, path: str, name: str | None) -> Scene:
    """The scene called `name`, of either split, or the only one. Raises ValueError otherwise."""
    splits: tuple[Split, ...] = ("train", "test")
    places: dict[str, tuple[Split, int]] = {
        known: (split, place) for split in splits for place, known in enumerate(source.names(split))
    }
    if name is None and len(places) == 1:
        (name,) = places
    if name not in places:
        shown = ", ".join(list(places)[:_SHOWN]) + (", ..." if len(places) > _SHOWN else "")
        told = f"no scene {name!r}, but" if name is not None else f"{len(places)} scenes:"
        raise ValueError(f"{path} holds {told} {shown}: name one of them with --scene")
    split, place = places[name]
    return source.scenes(split)[place]


if TYPE_CHECKING:
    from rich.table import Table

    from qgs.analysis.reconstruction import Reconstruction
    from qgs.composer import Recipe
    from qgs.data.photos.source import PhotosConfig
    from qgs.data.sampling import Sample
    from qgs.model import QueryGaussianModel
    from qgs.types import Gaussians


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("reconstruct")(reconstruct)


def reconstruct(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint file, or the run folder.")],
    photos: Annotated[
        str, typer.Argument(help="Folder of photos and cameras, chunks or archives, or its URL.")
    ],
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
    tune: Annotated[
        int, typer.Option(min=0, help="Steps of token tuning on the input photos; 0 for none.")
    ] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that is not empty.")
    ] = False,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="HxW", help="Height and width of the photos; the recipe's data.image_size."
        ),
    ] = None,
    scene_name: Annotated[
        str | None, typer.Option("--scene", help="Name of the scene, where there are several.")
    ] = None,
    device: Device = "auto",
) -> None:
    """Reconstruct a scene: PLY, renders beside photos, depth, an orbit, cameras.

    Of a folder that the model was trained on, held-out photos are compared with where there are.
    """
    check_out(out, overwrite)
    chosen = frame_list(frames, "--frames")
    compared = frame_list(holdout, "--holdout")
    pixels = parse_size(size)

    from rich.console import Console

    from qgs.analysis.reconstruction import choose_frames, write_reconstruction
    from qgs.analysis.reconstruction import reconstruct as run
    from qgs.data.sampling import make_sample, own_world
    from qgs.engine.distributed import choose_device
    from qgs.engine.folder import checkpoint_of
    from qgs.io.checkpoint import load, load_recipe

    file = checkpoint_of(checkpoint)
    device = choose_device(device)
    model, recipe = load(file, device), load_recipe(file)
    scene, seen = chosen_scene(recipe, photos, pixels, scene_name)
    wanted = inputs or recipe.views.inputs
    span = recipe.views.gap[1] + 1
    picked = choose_frames(len(scene), wanted, span, chosen, compared, held_out=scene.held_out)
    sample = make_sample(scene, *picked, recipe.views, mirror=False)
    sample = replace(sample, inputs=sample.inputs.to(device), targets=sample.targets.to(device))
    world = own_world(scene.cameras[list(picked[0])].c2w, recipe.views, scene.name)
    console = Console()
    gaussians, record = tuned(model, recipe, sample, tune) if tune else (None, None)
    if record:
        console.print(
            "{steps} steps of token tuning: photometric loss of the inputs {loss_before:.5f} -> "
            "{loss_after:.5f}".format(**record),
            highlight=False,
        )
    result = run(model, sample, world, seen, gaussians, record)
    console.print(score_table(result))
    for path in write_reconstruction(model, result, out):
        console.print(f"wrote {path}", soft_wrap=True)


def tuned(
    model: QueryGaussianModel, recipe: Recipe, sample: Sample, steps: int
) -> tuple[Gaussians, dict[str, Any]]:
    """Gaussians of tokens tuned on the inputs of `sample`, and a record of the tuning."""
    from qgs.engine.tuning import tune, tuning_loss

    loss, rate = tuning_loss(recipe), recipe.evaluation.tuning_rate
    tuning = tune(model, sample.inputs, loss, steps, rate)
    record = {
        "steps": steps,
        "rate": rate,
        "loss_before": tuning.losses[0],
        "loss_after": tuning.losses[-1],
    }
    return tuning.prediction.gaussians, record


def photos_config(recipe: Recipe, photos: str, size: tuple[int, int] | None = None) -> PhotosConfig:
    """How to read `photos` for a model of `recipe`: at `size`, else as it was trained.

    Held-out frames are kept when it was trained on these very photos.
    Raises ValueError for a recipe without data, which has no image size, when none is given.
    """
    from qgs.contracts import SceneSourceConfig
    from qgs.data.photos.source import PhotosConfig

    if ("data",) not in recipe.parts:
        if size is None:
            raise ValueError(
                "the checkpoint's recipe has no data, so its image size is not known; give it, "
                "such as --size 256x256"
            )
        return PhotosConfig(path=photos, image_size=size, holdout=0)
    trained = recipe.parts["data",].config
    assert isinstance(trained, SceneSourceConfig)
    image_size = size or trained.image_size
    if was_trained_on(recipe, photos):
        assert isinstance(trained, PhotosConfig)
        return trained.model_copy(update={"path": photos, "image_size": image_size})
    if isinstance(trained, PhotosConfig):
        return PhotosConfig(
            path=photos, image_size=image_size, background=trained.background, holdout=0
        )
    return PhotosConfig(path=photos, image_size=image_size, holdout=0)


def was_trained_on(recipe: Recipe, photos: str) -> bool:
    """Whether the data of `recipe` is the folder `photos`, or has it as a scene to train on."""
    from qgs.data.paths import opened_path
    from qgs.data.photos.source import PhotosConfig

    data = recipe.parts["data",].config if ("data",) in recipe.parts else None
    if not isinstance(data, PhotosConfig):
        return False
    root, folder = opened_path(data.path).resolve(), opened_path(photos).resolve()
    return folder in (root, root / folder.name, root / "train" / folder.name)


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
    """PSNR of every rendered view and of the baselines, inputs first, and the means by kind."""
    from rich.table import Table

    from qgs.analysis.reconstruction import BASELINES, KINDS

    table = Table(title=f"{result.sample.scene}: {result.gaussians.count:,} Gaussians")
    table.add_column("view")
    table.add_column("frames", justify="right")
    for column in ("PSNR", *BASELINES):
        table.add_column(column, justify="right")
    for kind in KINDS:
        scores = [score for score in result.scores if score.kind == kind]
        rows = [[score.psnr, *score.baselines.values()] for score in scores]
        for score, row in zip(scores, rows, strict=True):
            table.add_row(kind, str(score.frame), *(f"{value:.2f}" for value in row))
        if rows:
            means = [f"{sum(column) / len(rows):.2f}" for column in zip(*rows, strict=True)]
            table.add_row(f"{kind}, mean", str(len(rows)), *means, style="bold")
            table.add_section()
    return table
