"""Choice of the source that opens a path, also for a trained model."""

from collections.abc import Mapping
from typing import Any

from upath import UPath

from qgs.contracts import Component, SceneSource, SceneSourceConfig
from qgs.data.photos import with_cameras
from qgs.paths import opened_path
from qgs.wording import one_line, warn_once


def recognised(path: UPath, sources: Mapping[str, type[Component]]) -> str:
    """Return PLUGIN/NAME of the first of `sources` that recognises `path`, else qgs/photos.

    A warning names all if several do. Raises FileNotFoundError when `path` does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"{path} (from {UPath.cwd()}) does not exist: give the folder of a data set"
        )
    # Plugins first: photos lie in many a layout that only a plugin reads in full.
    asked = sorted(sources, key=lambda kind: kind.startswith("qgs/"))
    found: list[str] = []
    for kind in asked:
        source: Any = sources[kind]
        try:
            if source.recognises(path):
                found.append(kind)
        # One of a plugin must not hinder the others.
        except Exception as error:
            warn_once(f"{kind} is not asked whether it reads {path}: it raises {one_line(error)}")
    if len(found) > 1:
        warn_once(
            f"{path} looks like data of {' and of '.join(found)}, and is read as {found[0]}; to "
            "choose another, name it as `data.type` of a recipe"
        )
    # The errors of photos say best what a folder lacks.
    return found[0] if found else "qgs/photos"


def is_training_data(path: str, trained: SceneSourceConfig | None) -> bool:
    """Return whether a model with the data `trained` was trained on the data at `path`."""
    root = getattr(trained, "path", None)
    if trained is None or not isinstance(root, str):
        return False
    source: Any = trained.__component__
    return source.trains_on(opened_path(root).resolve(), opened_path(path).resolve())


def open_for(
    path: str,
    image_size: tuple[int, int] | None,
    trained: SceneSourceConfig | None,
    sources: Mapping[str, type[Component]],
) -> tuple[SceneSource, bool]:
    """Open the data at `path`; return too whether a model with data `trained` was trained on it.

    Then it has the same options, held-out frames included; else it is opened as `recognised`, and
    photos without cameras get some (`with_cameras`).
    image_size: (H, W), by default that of `trained`. Raises as `recognised` and the source do.
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
