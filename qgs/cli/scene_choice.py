"""Which scene `qgs reconstruct` opens, in a data set of any format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

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
    from qgs.cli.reconstruct import photos_config, was_trained_on
    from qgs.data import ChunksSource, Dl3dvSource, PhotosSource
    from qgs.data.chunks.source import ChunksConfig
    from qgs.data.dl3dv.source import Dl3dvConfig
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
