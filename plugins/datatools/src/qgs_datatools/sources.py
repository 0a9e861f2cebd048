"""Data sources of installed plugins: which of them reads a path, and its scenes to check."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import cache, partial

from PIL import Image
from upath import UPath

from qgs.composer.registry import load_sound_plugins
from qgs.contracts import Component, Scene, SceneSource, Split
from qgs.data.photos.reader import PhotoFrame
from qgs.data.recognition import recognised
from qgs_datatools.conventions import OPENCV
from qgs_datatools.findings import Candidate, Photo

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
    splits: tuple[Split, ...] = ("train", "test")
    known: set[str] = set()
    for split in splits:
        for place, name in enumerate(opened.names(split)):
            if name not in known:
                photos = partial(_photos, opened, split, place)
                yield Candidate(name, name, kind, OPENCV, photos, split)
            known.add(name)


def _photos(source: SceneSource, split: Split, place: int) -> list[Photo]:
    scene = source.scenes(split)[place]
    cameras = scene.cameras
    return [
        Photo(
            PhotoFrame(
                scene.frame_name(i),
                UPath(scene.frame_name(i)),
                cameras.c2w[i].double().numpy(),
                tuple(cameras.intrinsics[i].tolist()),
                cameras.size,
            ),
            partial(_png, scene, i),
        )
        for i in range(len(scene))
    ]


def _png(scene: Scene, frame: int) -> bytes:
    pixels = scene.images([frame])[0].mul(255).round().byte().permute(1, 2, 0)
    file = io.BytesIO()
    Image.fromarray(pixels.numpy()).save(file, "png")
    return file.getvalue()
