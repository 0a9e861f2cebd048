"""Find the installed data source that can read a path, and list the scenes to check."""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from typing import Any, get_args

import numpy as np
from upath import UPath

from qgs.contracts import Component, Scene, SceneSource, Split
from qgs.data.photos.reader import PhotoFrame
from qgs.data.recognition import recognised
from qgs.data.scenes import resized
from qgs.drawing.images import png_bytes, rgb_picture
from qgs.paths import opened_path
from qgs.recipe import resolve
from qgs.recipe.registry import Registry, load_plugin
from qgs.reconstruction.scenes import installed_sources
from qgs_photos.datasets.encoded import as_intrinsics
from qgs_photos.datatools.photos import Candidate, Photo, Photos

OF_FILES = ("qgs", "datasets")
"""Plugins whose data sets are checked file by file. For a data set of another plugin, the scenes
that its data source loads are checked."""

# Of the images that a source is asked for.
_SIZE = (256, 256)


@cache
def sources(format: str = "auto") -> dict[str, type[Component]]:
    """Return the data sources that have an option `path`, by type PLUGIN/NAME.

    format: "auto" searches all plugins, and warns of those that cannot be imported; PLUGIN/NAME
    searches PLUGIN and the plugins OF_FILES, which are `qgs` and `datasets`; any other format
    searches only these two. Raises PluginError if PLUGIN cannot be imported.
    """
    if format == "auto":
        found = installed_sources()
    else:
        plugin, slash, _ = format.partition("/")
        names = [*OF_FILES, *([plugin] if slash else [])]
        found = Registry({name: load_plugin(name) for name in names}).components("data")
    return {kind: source for kind, source in found.items() if "path" in source.Config.model_fields}


def opened_source(
    path: str, options: Sequence[str], image_size: tuple[int, int] | None
) -> SceneSource:
    """Return the source of the scenes at `path`.

    path: data set or recipe. options: settings of the source, as KEY=VALUE.
    """
    recipe: Any = path
    if not path.endswith((".yaml", ".yml")):
        kind = recognised(opened_path(path), sources())
        recipe = {"recipe": 1, "data": {"type": kind, "path": path}}
        # components of qgs itself are there without being named
        recipe["plugins"] = [*{kind.partition("/")[0]} - {"qgs"}]
    source = resolve(recipe, [f"data.{option}" for option in options]).build_data()
    return source if image_size is None else resized(source, source.config, image_size)


def source_scenes(kind: str, path: UPath, images: str | None) -> Iterator[Candidate]:
    """Yield the scenes at `path` that are to be checked, opened by a plugin's data source.

    Images are checked as the source returns them. kind: PLUGIN/NAME. images: value of the
    source's option `images`; None keeps its default. Raises ValueError if the source has no such
    option, and the errors of the source.
    """
    source = sources(kind)[kind]
    assert issubclass(source, SceneSource)
    if images is not None and "images" not in source.Config.model_fields:
        raise ValueError(f"{kind} has no option `images`: leave --images out")
    config = source.config_for(str(path), _SIZE, None)
    opened = source(config if images is None else config.model_copy(update={"images": images}))
    # a scene in both splits is checked once, and may be in an index
    known = set[str]()
    for split in reversed(get_args(Split)):
        for place, name in enumerate(opened.names(split)):
            if name not in known:
                yield Candidate(name, kind, partial(_photos, opened, split, place), split)
            known.add(name)


def _photos(source: SceneSource, split: Split, place: int) -> Photos:
    scene = source.scenes(split)[place]
    return [_photo(scene, frame) for frame in range(len(scene))], scene.missing


def _photo(scene: Scene, frame: int) -> Photo:
    camera = scene.cameras[frame]
    name = scene.frame_name(frame)
    listed = PhotoFrame(
        name=name,
        path=UPath(name),
        c2w=camera.c2w.double().numpy(),
        intrinsics=as_intrinsics(camera.intrinsics),
        size=camera.size,
        time=None if scene.times is None else float(scene.times[frame]),
    )
    return Photo(
        listed,
        lambda: png_bytes(rgb_picture(scene.images([frame])[0])),
        {"mask": lambda: _read_mask(scene, frame)},
    )


def _read_mask(scene: Scene, frame: int) -> np.ndarray | None:
    mask = scene.masks([frame])
    return None if mask is None else mask[0, 0].numpy()
