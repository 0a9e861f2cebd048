"""Which training scene comes when."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np


class SceneOrder:
    """The scenes of an endless sequence of samples: a function of (groups, seed) alone.

    groups: scene indices by where they are stored, see `SceneSource.groups`. Each epoch visits
    every scene once: the groups in a random order, the scenes of a group one after another in a
    random order. Raises ValueError unless the groups hold each of `count` scenes once.
    """

    def __init__(self, groups: Sequence[Sequence[int]], count: int, seed: int) -> None:
        self._groups = [np.asarray(group, np.int64) for group in groups if len(group)]
        listed = np.concatenate([np.empty(0, np.int64), *self._groups])
        if not np.array_equal(np.sort(listed), np.arange(count)):
            raise ValueError(
                f"the data source has {count} training scenes, but its groups list "
                f"{len(listed)} indices, not each scene once; this is a mistake of the data source"
            )
        self._count = count
        self._seed = seed
        self._epoch = lru_cache(maxsize=2)(self._draw_epoch)

    def scene(self, sample: int) -> int:
        """The scene of a sample, counted from 0 over all epochs."""
        epoch, position = divmod(sample, self._count)
        return int(self._epoch(epoch)[position])

    @property
    def fingerprint(self) -> str:
        """Equal for equal groups: sequences of equal fingerprint and seed visit alike."""
        digest = hashlib.sha256()
        for group in self._groups:
            digest.update(len(group).to_bytes(8, "little") + group.astype("<i8").tobytes())
        return digest.hexdigest()[:16]

    def _draw_epoch(self, epoch: int) -> np.ndarray:
        rng = np.random.default_rng([self._seed, 0, epoch])
        shuffled = rng.permutation(len(self._groups))
        return np.concatenate([rng.permutation(self._groups[index]) for index in shuffled])
