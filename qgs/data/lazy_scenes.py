"""Sequences of scenes that are made when they are asked for."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import overload

from qgs.contracts import Scene


class LazyScenes(Sequence[Scene]):
    """Scenes by place; an implementation gives their number and `scene(place)`."""

    @abstractmethod
    def scene(self, place: int) -> Scene:
        """The scene at `place`, from 0 to below the number of scenes."""

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Scene]: ...
    def __getitem__(self, index: int | slice) -> Scene | Sequence[Scene]:
        places = range(len(self))
        if isinstance(index, slice):
            return [self.scene(place) for place in places[index]]
        if not -len(self) <= index < len(self):
            raise IndexError(f"scene {index} of {len(self)}")
        return self.scene(places[index])
