"""Data sources of installed plugins: which of them reads a path, and its scenes to check."""

from collections.abc import Iterator
from functools import cache, partial
from typing import get_args

import numpy as np
from upath import UPath

from qgs.composer.registry import load_sound_plugins
from qgs.contracts import Component, Scene, SceneSource, Split
from qgs.data.photos.reader import PhotoFrame
from qgs.data.recognition import recognised
from qgs_datatools.candidates import Candidate, Photo
from qgs_datatools.conventions import OPENCV
from qgs_datatools.entries import Encoding

_SIZE = (256, 256)  # of the images that a source is asked for


@cache
def sources() -> dict[str, type[Component]]:
    """The sources of qgs and of every installed plugin by PLUGIN/NAME."""
    return load_sound_plugins()[0].components("data")


def kind_of(path: UPath) -> str:
    """PLUGIN/NAME of the source that reads `path`, less `qgs/`. Raises as `recognised`."""
    return recognised(path, sources()).removeprefix("qgs/")


def source_scenes(kind: str, path: UPath) -> Iterator[Candidate]:
    """The scenes of a plugin's source, as it delivers them. Raises as the source does."""
    source = sources()[kind]
    assert issubclass(source, SceneSource)
    opened = source(source.config_for(str(path), _SIZE, None))
    known: set[str] = set()
    for split in get_args(Split):
        for place, name in enumerate(opened.names(split)):
            if name not in known:
                photos = partial(_photos, opened, split, place)
                yield Candidate(name, name, kind, OPENCV, photos, split)
            known.add(name)


def _photos(source: SceneSource, split: Split, place: int) -> list[Photo]:
    scene = source.scenes(split)[place]
    return [Photo(_listed(scene, i), partial(_image_file, scene, i)) for i in range(len(scene))]


def _listed(scene: Scene, frame: int) -> PhotoFrame:
    camera, name = scene.cameras[frame], scene.frame_name(frame)
    fx, fy, cx, cy = camera.intrinsics.tolist()
    c2w = camera.c2w.double().numpy()
    return PhotoFrame(name, UPath(name), c2w, (fx, fy, cx, cy), camera.size)


def _image_file(scene: Scene, frame: int) -> bytes:
    pixels = scene.images([frame])[0].permute(1, 2, 0).mul(255).round().byte().numpy()
    return Encoding().image(np.ascontiguousarray(pixels))
