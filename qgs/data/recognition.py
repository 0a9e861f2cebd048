"""Which source opens a path, and opening it for a trained model."""

from collections.abc import Mapping

from upath import UPath

from qgs.contracts import Component, SceneSource, SceneSourceConfig, component_of
from qgs.data.paths import opened_path


def recognised(path: UPath, sources: Mapping[str, type[Component]]) -> str:
    """PLUGIN/NAME of the first of `sources` that recognises `path`, else qgs/photos.

    Photos say best what a folder lacks. Raises FileNotFoundError when `path` does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"{path} (from {UPath.cwd()}) does not exist: give the folder of a data set"
        )
    found = (
        kind
        for kind, source in sources.items()
        if issubclass(source, SceneSource) and source.recognises(path)
    )
    return next(found, "qgs/photos")


def open_for(
    path: str,
    image_size: tuple[int, int] | None,
    trained: SceneSourceConfig | None,
    sources: Mapping[str, type[Component]],
) -> tuple[SceneSource, bool]:
    """The data at `path`, and whether a model with the data `trained` was trained on it.

    Then it has the same options, held-out frames included; else it is opened as `recognised`.
    image_size: (H, W), by default that of `trained`. Raises as `recognised` and the source do.
    """
    size = image_size or (trained or SceneSourceConfig()).image_size
    place = opened_path(path)
    root = getattr(trained, "path", None)
    if trained is not None and isinstance(root, str):
        source = component_of(trained)
        assert issubclass(source, SceneSource)
        if source.trains_on(opened_path(root).resolve(), place.resolve()):
            return source(trained.model_copy(update={"path": path, "image_size": size})), True
    source = sources[recognised(place, sources)]
    assert issubclass(source, SceneSource)
    return source(source.config_for(path, size, trained)), False
