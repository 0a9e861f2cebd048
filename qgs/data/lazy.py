"""Sequences of scenes made on demand, an LRU cache, warnings given once."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from threading import Lock
from typing import Generic, TypeVar, overload

from qgs.contracts import Scene

Value = TypeVar("Value")


class BoundedCache(Generic[Value]):
    """Keeps what was used last, up to `limit` in all; may be used by several threads.

    cost: what a value counts for, such as its bytes. A copy in another process starts empty.
    """

    def __init__(self, limit: int, cost: Callable[[Value], int]) -> None:
        self._limit, self._cost = limit, cost
        self._kept: OrderedDict[Hashable, Value] = OrderedDict()
        self._total, self._lock = 0, Lock()

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._limit, self._cost)

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """What is kept for `key`, or what `make` returns, which is kept if it fits."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        value = make()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = value
                self._total += self._cost(value)
            while self._total > self._limit:
                self._total -= self._cost(self._kept.popitem(last=False)[1])
        return value


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


_log = logging.getLogger(__name__)


@lru_cache(maxsize=4096)
def warn_once(message: str) -> None:
    """Log `message`, unless this process has logged it before."""
    _log.warning("%s", message)


def a_type(value: object) -> str:
    """The type of `value` with its article, such as "an int"."""
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"
