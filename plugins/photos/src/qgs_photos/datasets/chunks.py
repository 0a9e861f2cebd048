"""`datasets/chunks`: read chunks in RealEstate10K's format, which `chunk_files` describes."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from itertools import islice
from typing import get_args

import numpy as np
import torch
from PIL import Image
from pydantic import NonNegativeInt
from torch import Tensor
from upath import UPath

from qgs.contracts import Scene, SceneSource, Split
from qgs.data.images import CropResize, decode_rgb, to_tensor
from qgs.data.photos.reader import Size, size_problems
from qgs.data.scenes import BoundedCache, LazyScenes, LazySource
from qgs.data.view_samplers import held_out_frames
from qgs.paths import listing, opened_path
from qgs.types import Cameras
from qgs.wording import listed, warn_once
from qgs_photos.datasets.chunk_files import (
    SUFFIX,
    Chunk,
    Record,
    has_chunks,
    list_scenes,
)

# Chunks kept open.
_OPEN = 4


class ManyScenesConfig(SceneSource.Config):
    """Options of data sets with many scenes."""

    max_scenes: NonNegativeInt = 0
    """Use only the first scenes of each split, at most this number. 0 uses all."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB in [0, 1] behind transparent pixels."""


class ChunksConfig(ManyScenesConfig):
    """Options of `datasets/chunks`."""

    path: str
    """Folder or fsspec URL that holds train/ and test/. A relative path starts at the working
    directory. From a URL, every process and every data-loader worker reads whole chunks: copy the
    data set to a local disk for training."""
    holdout: NonNegativeInt = 0
    """A number N above 0 holds out every Nth frame of a scene for evaluation, from frame N // 2
    on. 0 holds out the frames that the chunk lists as held out. Only chunks of `qgs data pack`
    can have such a list; without it, 0 holds out none."""
    min_frames: NonNegativeInt = 0
    """Leave out scenes with fewer frames than this number. To count frames, every chunk is opened
    at the start. 0 keeps all scenes and opens none."""


class ChunkScene(Scene):
    """Scene that is read from its chunk file on first use.

    The world frame of the cameras is that of the poses in the file.
    """

    def __init__(
        self, name: str, file: UPath, config: ChunksConfig, chunks: BoundedCache[Chunk]
    ) -> None:
        self.name = name
        self._file = file
        self.config = config
        self._chunks = chunks

    @property
    def record(self) -> Record:
        """The scene as stored."""
        return self._chunks.get(str(self._file), lambda: Chunk(self._file)).record(self.name)

    @cached_property
    def _length(self) -> int:
        return len(self.record)

    def __len__(self) -> int:
        return self._length

    @cached_property
    def held_out(self) -> Sequence[int]:  # type: ignore[override]  # known once the chunk is open
        """Held-out frames: every Nth if the option `holdout` is N > 0, else those in the chunk."""
        every = self.config.holdout
        return held_out_frames(len(self), every) if every else self.record.held_out

    @cached_property
    def times(self) -> Tensor | None:  # type: ignore[override]  # known once the chunk is open
        """Times (F,) of the frames, float64; None for a static scene."""
        return self.record.times

    @cached_property
    def cameras(self) -> Cameras:
        """Cameras (F,) of all frames, float64, with intrinsics for the size that `images` returns.

        Raises ValueError for a pose or intrinsics that are invalid.
        """
        record = self.record
        target = self.config.image_size
        record.require_usable()
        sizes = torch.tensor(record.image_sizes)
        intrinsics = record.cameras[:, :4].double() * sizes[:, [1, 0, 1, 0]]
        for size in set(record.image_sizes):
            alike = (sizes == torch.tensor(size)).all(1)
            intrinsics[alike] = CropResize(size, target).intrinsics(intrinsics[alike])
        return Cameras(torch.linalg.inv(record.w2c), intrinsics, target)

    def frame_name(self, frame: int) -> str:
        """Return the name of a frame in the chunk, or its time stamp if the chunk has no names."""
        return self.record.names[frame]

    def stored_size(self, frame: int) -> Size:
        """Return (H, W) of the stored photo of `frame`. Raises ValueError if it is unreadable."""
        return self.record.stored_size(frame)

    def images(self, frames: Sequence[int]) -> Tensor:
        """Return images (len(frames), 3, H, W), float32 in [0, 1].

        Raises ValueError for an image that cannot be decoded.
        """
        record = self.record
        return to_tensor(np.stack([self._pixels(record, frame) for frame in frames]))

    def masks(self, frames: Sequence[int]) -> Tensor | None:
        """Return masks (len(frames), 1, H, W), 1 on the object; None if the scene has no masks.

        In a scene with masks, the mask of a frame without one is 1 everywhere.
        """
        record = self.record
        if record.masks is None:
            return None
        masks = np.stack([self._mask(record, frame) for frame in frames])
        return torch.from_numpy(masks)[:, None].float().div_(255)

    def _pixels(self, record: Record, frame: int) -> np.ndarray:
        file = io.BytesIO(record.images[frame].numpy().tobytes())
        try:
            image = decode_rgb(file, self.config.background)
        except OSError as error:
            raise ValueError(
                f"{record.place(frame)} cannot be read as an image ({error}): copy or pack the "
                "chunk again, or remove the scene from index.json"
            ) from error
        size = (image.height, image.width)
        # intrinsics were cropped for the size that the scene gives
        for problem in size_problems(size, record.image_sizes[frame]):
            raise ValueError(
                f"{record.place(frame)}: {problem.reason}: pack the data set again with "
                "`qgs data pack`, which writes the entry 'sizes' that chunks of mixed sizes need"
            )
        return CropResize(size, self.config.image_size).image(image)

    def _mask(self, record: Record, frame: int) -> np.ndarray:
        mask = record.mask(frame)
        if mask is None:
            return np.full(self.config.image_size, 255, np.uint8)
        crop = CropResize((mask.shape[0], mask.shape[1]), self.config.image_size)
        return crop.image(Image.fromarray(mask))


class ChunksSource(LazySource):
    """Source of the scenes in the chunk files of a folder.

    The folder holds train/ and test/ with chunks, or it holds chunks directly, all of which are
    for training. A data set without test chunks is evaluated on the held-out frames of its training
    scenes, if they have any. Scenes whose chunk is named by index.json but does not exist are left
    out; a warning counts and names them.
    """

    name = "chunks"
    Config = ChunksConfig
    tells_times = True
    not_in_protocol = frozenset({"path", "max_scenes", "min_frames"})
    split_options = frozenset({"holdout"})

    def __init__(self, config: ChunksConfig) -> None:
        super().__init__(config)
        opener = partial(ChunkScene, config=config, chunks=BoundedCache(_OPEN))
        self._nothing = LazyScenes({}, opener)
        splits: dict[Split, LazyScenes] = {"train": self._nothing}
        for split, folder in _folders(opened_path(config.path)).items():
            files = _long_enough(folder, config, opener)
            splits[split] = first_scenes(files, config, opener)
        self.splits = splits

    @classmethod
    def recognises(cls, path: UPath) -> bool:
        """Return whether `path` is or holds chunks, or its train/ or test/ has any or an index."""
        inside = [path, *listing(path)]
        splits = [item for item in inside if item.name in ("train", "test")]
        return any(map(has_chunks, splits)) or any(item.suffix == SUFFIX for item in inside)

    def scenes(self, split: Split) -> LazyScenes:
        """Return the scenes of a split.

        Without test chunks, the test scenes are the training scenes if frames are held out in the
        first chunk; otherwise there are no test scenes.
        """
        if split in self.splits:
            return self.splits[split]
        train = self.splits["train"]
        # one chunk tells: `qgs data pack` holds frames out in all scenes or in none
        first = next(iter(self.groups("train")), ())
        return train if any(train[i].held_out for i in first) else self._nothing

    def groups(self, split: Split) -> Sequence[Sequence[int]]:
        """Return the indices of a split's scenes, in one group for each chunk file."""
        by_file: dict[str, list[int]] = {}
        for index, file in enumerate(self.scenes(split).places.values()):
            by_file.setdefault(str(file), []).append(index)
        return list(by_file.values())


def first_scenes(
    places: Mapping[str, UPath], config: ManyScenesConfig, opener: Callable[[str, UPath], Scene]
) -> LazyScenes:
    """Return the first `config.max_scenes` scenes of `places`; 0 returns all.

    places: folder or file of each scene by name. opener: function that opens a scene; it takes the
    scene's name and its folder or file.
    """
    return LazyScenes(dict(islice(places.items(), config.max_scenes or None)), opener)


def _folders(path: UPath) -> dict[Split, UPath]:
    if not path.is_dir():
        raise FileNotFoundError(
            f"the chunks' folder {path} does not exist or is no folder: give the folder that holds "
            "train/ and test/"
        )
    found: dict[Split, UPath] = {s: path / s for s in get_args(Split) if has_chunks(path / s)}
    if found:
        return found
    if has_chunks(path):
        return {"train": path}
    inside = listed(sorted(item.name for item in path.iterdir())) or "nothing"
    raise FileNotFoundError(
        f"{path} holds no chunks: expected train/ or test/ with index.json and .torch files, "
        f"found {inside}. `qgs data pack` makes chunks of other formats"
    )


def _long_enough(
    folder: UPath, config: ChunksConfig, opener: Callable[[str, UPath], ChunkScene]
) -> dict[str, UPath]:
    """Return a folder's scenes with at least `min_frames` frames; warn of the shorter scenes."""
    files = list_scenes(folder)
    if not config.min_frames:
        return files
    # in the order of the files: few of them stay open
    by_file = sorted(files.items(), key=lambda item: str(item[1]))
    frames = {key: len(opener(key, file)) for key, file in by_file}
    short = {key: count for key, count in frames.items() if count < config.min_frames}
    if short:
        names = listed(f"{key} ({count})" for key, count in short.items())
        warn_once(
            f"{len(short)} of {len(files)} scenes of {folder} have fewer than "
            f"{config.min_frames} frames (min_frames) and are left out: {names}"
        )
    return {key: file for key, file in files.items() if key not in short}
