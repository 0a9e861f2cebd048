"""Choice of the data source that reads a path, and opening of data for a trained model."""

from collections.abc import Mapping
from typing import Any

from upath import UPath

from qgs.contracts import Component, SceneSource, SceneSourceConfig
from qgs.data.photos import with_cameras
from qgs.paths import opened_path
from qgs.types import Size
from qgs.wording import one_line, warn_once


def recognised(path: UPath, sources: Mapping[str, type[Component]]) -> str:
    """Return the name PLUGIN/NAME of the first data source that recognises `path`.

    The name is qgs/photos if no source does. If several sources recognise the path, a warning names
    them all. Raises FileNotFoundError if `path` does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"{path} (from {UPath.cwd()}) does not exist: give the folder of a data set"
        )
    found: list[str] = []
    # Plug-ins come first: many layouts hold photos, but only a plug-in reads all of the layout.
    for kind in sorted(sources, key=lambda kind: kind.startswith("qgs/")):
        source: Any = sources[kind]
        try:
            if source.recognises(path):
                found.append(kind)
        # A failing plug-in must not stop the others.
        except Exception as error:
            warn_once(f"{kind} failed to recognise {path} and is not used: {one_line(error)}")
    if len(found) > 1:
        warn_once(
            f"{path} looks like data of {' and of '.join(found)}, and is read as {found[0]}; to "
            "choose another type, set `data.type` in a recipe"
        )
    # The errors of `qgs/photos` explain best what a folder lacks.
    return found[0] if found else "qgs/photos"


def is_training_data(path: str, trained: SceneSourceConfig | None) -> bool:
    """Return whether the data at `path` was training data of a model.

    trained: options of the data that the model was trained on. The result is False if it is None
        (unknown).
    """
    root = getattr(trained, "path", None)
    if trained is None or not isinstance(root, str):
        return False
    source: Any = trained.__component__
    return source.trains_on(opened_path(root).resolve(), opened_path(path).resolve())


def open_for(
    path: str,
    image_size: Size | None,
    trained: SceneSourceConfig | None,
    sources: Mapping[str, type[Component]],
) -> tuple[SceneSource, bool]:
    """Open the data at `path` for a model; return the source and whether the model trained on it.

    Training data opens with the options of the training, including held-out frames. Other data
    opens with the source from `recognised`; `with_cameras` adds cameras to photos without cameras.
    trained: options of the data that the model was trained on, or None if unknown. image_size:
    (H, W), by default that of `trained`. Raises the errors of `recognised` and of the source.
    """
    size = image_size or (trained or SceneSourceConfig()).image_size
    source: Any
    if trained is not None and is_training_data(path, trained):
        source = trained.__component__
        return source(trained.model_copy(update={"path": path, "image_size": size})), True
    opened = opened_path(path)
    kind = recognised(opened, sources)
    if kind == "qgs/photos":
        path = str(with_cameras(opened))
    source = sources[kind]
    return source(source.config_for(path, size, trained)), False
