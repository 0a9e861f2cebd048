"""List the scenes to check in chunks, in folders of photos, and of other data sources."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache, partial
from posixpath import join
from typing import Any, get_args

import numpy as np
import torch
from upath import UPath

from qgs.contracts import Component, Scene, SceneSource, Split
from qgs.data.images import decode_depth, read_image
from qgs.data.photos import formats_of, read_listing
from qgs.data.photos.reader import PhotoFrame, Size
from qgs.data.photos.source import folder_name, upright, whole_mask
from qgs.data.recognition import recognised
from qgs.data.scenes import resized
from qgs.drawing.images import png_bytes, rgb_picture
from qgs.paths import opened_path, read_file
from qgs.recipe import resolve
from qgs.recipe.registry import Registry, load_plugin
from qgs.reconstruction.scenes import installed_sources
from qgs.wording import counted, listed
from qgs_photos.datasets.chunk_files import (
    INDEX,
    SUFFIX,
    Record,
    has_chunks,
    load_chunk,
    parse_record,
    read_chunk_index,
)
from qgs_photos.datasets.dl3dv import find_scenes, scene_folder
from qgs_photos.datatools.findings import Finding, Severity
from qgs_photos.datatools.photos import Candidate, Photo, Photos

OF_FILES = ("qgs", "datasets")
"""Plugins whose data sets are checked file by file. For a data set of another plugin, the scenes
that its data source loads are checked."""

Items = Iterator[Candidate | Finding]
"""Scenes to check, and findings about files of the data set."""

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


def opened_source(path: str, options: Sequence[str], image_size: Size | None) -> SceneSource:
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
                yield Candidate(name, kind, partial(_of_source, opened, split, place), split)
            known.add(name)


def _of_source(source: SceneSource, split: Split, place: int) -> Photos:
    scene = source.scenes(split)[place]
    return [source_photo(scene, frame) for frame in range(len(scene))], scene.missing


def source_photo(
    scene: Scene, frame: int, encode: Callable[[np.ndarray], bytes] = png_bytes
) -> Photo:
    """Return a frame as a photo whose file has the pixels that the scene returns.

    encode: function that returns the file's bytes from pixels (H, W, 3), uint8.
    """
    camera = scene.cameras[frame]
    fx, fy, cx, cy = camera.intrinsics.tolist()
    name = scene.frame_name(frame)

    def mask() -> np.ndarray | None:
        masks = scene.masks([frame])
        return None if masks is None else rgb_picture(masks[0])[..., 0]

    listed = PhotoFrame(
        name=name,
        path=UPath(name),
        c2w=camera.c2w.double().numpy(),
        intrinsics=(fx, fy, cx, cy),
        size=camera.size,
        time=None if scene.times is None else float(scene.times[frame]),
    )
    return Photo(
        listed,
        lambda: encode(rgb_picture(scene.images([frame])[0])),
        {"mask": mask},
    )


def photo_folders(root: UPath, wanted: str, images: str | None, name: str = "") -> Items:
    """Yield the scenes in `root`: `root` itself, its subfolders, or those in train/ and test/.

    wanted: name of a format; scenes in other formats are left out. "auto" reads each scene in the
    first format that it has. images: folder of photos inside each scene; None takes the format's
    default. name: name of the scene if `root` is one; "" takes that of the folder. A subfolder that
    lists no cameras, beside others that do, yields a warning.
    """
    if held := formats_of(root):
        kind = held[0] if wanted == "auto" else wanted
        if kind in held:
            photos = partial(_of_folder, root, kind, images)
            yield Candidate(name or folder_name(root), kind, photos)
        return
    inside = sorted((item for item in root.iterdir() if item.is_dir()), key=str)
    scenes = [item for item in inside if formats_of(item)]
    for folder in inside:
        if folder in scenes or (not scenes and folder.name in ("train", "test")):
            yield from photo_folders(folder, wanted, images, folder.name)
        elif scenes and not folder.name.startswith("."):
            reason = "the folder lists no cameras, and is not checked"
            fix = f"run `qgs data check {folder}` if it is another data set, else move it away"
            yield Finding(folder.name, reason, fix, severity="warning")


def dl3dv_scenes(path: UPath, images: str | None) -> Iterator[Candidate]:
    """Yield the DL3DV scenes in `path`. Raises FileNotFoundError if there is no scene."""
    for name, place in find_scenes(path).items():
        # an archive is opened when its scene's turn comes
        yield Candidate(
            name, "dl3dv", lambda place=place: _of_folder(scene_folder(place), "nerfstudio", images)
        )


def _of_folder(folder: UPath, kind: str, images: str | None) -> Photos:
    listing = read_listing(folder, kind, images)
    frames = map(upright, listing.frames)
    return [_folder_photo(frame, frame.path in listing.present) for frame in frames], ()


def _folder_photo(frame: PhotoFrame, exists: bool) -> Photo:
    return Photo(
        frame,
        lambda: read_file(frame.path),
        {
            "mask": lambda: frame.mask and np.array(whole_mask(frame)),
            "depth map": lambda: frame.depth and read_image(frame.depth, decode_depth),
        },
        exists,
    )


_REPACK = "pack the data set again with `qgs data pack`, or copy the file again"


def chunk_scenes(path: UPath) -> Items:
    """Yield the scenes of a data set of chunks, and faults of its files.

    path: folder with train/ and test/, folder of chunks, or one chunk.
    """
    parts = {split: path / split for split in ("train", "test") if has_chunks(path / split)}
    found = defaultdict[str, dict[str, str]](dict)
    for split, part in (parts or {"": path}).items():
        yield from _folder_scenes(split, part, found[split])
    for key in sorted(found["train"].keys() & found["test"].keys()):
        reason = "the scene is in train and in test, so that models are tested on training data"
        yield Finding(key, reason, "remove it from train or from test", severity="warning")


def _folder_scenes(split: str, folder: UPath, found: dict[str, str]) -> Items:
    """Yield the scenes and faults of one folder of chunks, or of one chunk.

    found: mapping to which the file name of each scene's chunk is added, by the scene's name.
    """
    if folder.is_file():
        files = [folder]
    else:
        files = sorted((item for item in folder.iterdir() if item.suffix == SUFFIX), key=str)
    for file in files:
        yield from _file_scenes(split, file, found)
    if not (folder / INDEX).is_file():
        return
    label = join(split, INDEX)
    try:
        index = read_chunk_index(folder / INDEX)
    except (OSError, ValueError) as error:
        yield Finding(label, str(error), "write it again: a JSON mapping from scene to chunk file")
        return
    lost = defaultdict[str, list[str]](list)
    for key, name in index.items():
        if found.get(key) != name:
            lost[name].append(key)
    for name, keys in lost.items():
        missing = f"{counted(len(keys), 'scene')} that it does not hold: {listed(keys)}"
        reason = f"{INDEX} lists for this file {missing}"
        fix = f"copy the chunk again, or remove these scenes from {INDEX}"
        yield Finding(join(split, name), reason, fix)
    if unnamed := sorted(found.keys() - index.keys()):
        reason = f"the index does not name {listed(unnamed)}, so that no reader finds these scenes"
        severity: Severity = "warning" if index else "error"
        yield Finding(label, reason, "add the scenes to the index", severity=severity)


def _file_scenes(split: str, file: UPath, found: dict[str, str]) -> Items:
    label = join(split, file.name)
    try:
        entries = load_chunk(file)
    except (OSError, ValueError) as error:
        text = " ".join(str(error).replace(f"{file} ", "the file ").split())
        # without the remedy behind the last colon
        yield Finding(label, text.rpartition(": ")[0] or text, _REPACK)
        return
    scenes = 0
    for place, entry in enumerate(entries):
        key = entry.get("key") if isinstance(entry, Mapping) else None
        if isinstance(key, str) and key in found:
            reason = f"the scene in {label} is in this split twice"
            yield Finding(key, reason, f"remove one of the two scenes, or {_REPACK}")
        elif isinstance(key, str):
            found[key] = file.name
            scenes += 1
            yield Candidate(key, "chunks", partial(_of_chunk, file, place), split)
    if scenes < len(entries) or not entries:
        reason = f"{scenes} of its {len(entries)} entries are mappings with a 'key' not used before"
        yield Finding(label, reason, _REPACK)


_entries = lru_cache(maxsize=1)(load_chunk)


def _of_chunk(file: UPath, place: int) -> Photos:
    record = parse_record(str(file), _entries(file)[place])
    if record.sizes is None:
        # the most frequent in the headers; without it each image would be opened again
        stored = Counter({(1, 1): 0})
        for frame in range(len(record)):
            with suppress(ValueError):
                stored[record.stored_size(frame)] += 1
        usual, _ = stored.most_common(1)[0]
        record = replace(record, sizes=torch.tensor([usual] * len(record)))
    return [chunk_photo(record, *item) for item in enumerate(record.image_sizes)], ()


def chunk_photo(record: Record, frame: int, size: Size) -> Photo:
    """Return a frame of a chunk as a photo. size: (H, W) of the photo."""
    name = record.names[frame]
    try:
        c2w = np.linalg.inv(record.w2c[frame].numpy())
    # a singular matrix is told as a pose with NaN
    except np.linalg.LinAlgError:
        c2w = np.full((4, 4), np.nan)
    photo = PhotoFrame(
        name=name,
        path=UPath(name),
        c2w=c2w,
        intrinsics=record.intrinsics(frame, size),
        size=size,
        time=None if record.times is None else float(record.times[frame]),
        problems=tuple(record.unit_problems(frame)),
    )
    return Photo(
        photo,
        lambda: record.images[frame].numpy().tobytes(),
        {"mask": lambda: record.mask(frame)},
    )
