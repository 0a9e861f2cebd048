"""Helpers for data sources: a cache, and lists of scenes that open when they are needed."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from threading import Lock
from typing import Any, Generic, TypeVar

from qgs.contracts import Scene, SceneSource, SceneSourceConfig, Split
from qgs.types import Size

Value = TypeVar("Value")


class BoundedCache(Generic[Value]):
    """Thread-safe cache that drops the least recently used values. A pickled copy is empty.

    limit: largest sum of the costs of kept values. cost: function that returns the cost of a value;
        by default each value costs 1.
    """

    def __init__(self, limit: int, cost: Callable[[Value], int] | None = None) -> None:
        self._limit = limit
        self._cost = cost
        self._kept: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self._total = 0
        self._lock = Lock()

    # Copies in workers start empty: locks cannot be pickled, and sending images would be wasteful.
    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._limit, self._cost)

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the cached value of `key`, or else the result of `make`, which is then cached.

        A value that costs more than the limit is not cached.
        """
        with self._lock:
            if key in self._kept:
                # The front is the least recently used.
                self._kept.move_to_end(key)
                return self._kept[key][0]
        # Made outside of the lock, so that threads decode in parallel; two may make the same value.
        value = make()
        cost = self._cost(value) if self._cost else 1
        with self._lock:
            # Another thread may have kept its own value in the meantime.
            if key not in self._kept:
                self._kept[key] = (value, cost)
                self._total += cost
            while self._total > self._limit:
                self._total -= self._kept.popitem(last=False)[1][1]
        return value


class LazyScenes(Sequence[Scene]):
    """Sequence of scenes that are opened when they are indexed; at most 64 stay open.

    open: function that opens a scene from its name and its entry in `places`. places: whatever
        `open` needs, such as a folder, by name of the scene.
    """

    def __init__(self, places: Mapping[str, Any], open: Callable[[str, Any], Scene]) -> None:
        self.names = list(places)
        self.places = places
        self._open = open
        self._opened: BoundedCache[Scene] = BoundedCache(64)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: Any) -> Any:
        """Return the scene at an index, or the scenes at a slice."""
        name = self.names[index]
        # The index is a slice.
        if isinstance(name, list):
            return [self[place] for place in range(len(self))[index]]
        return self._opened.get(name, lambda: self._open(name, self.places[name]))


class LazySource(SceneSource):
    """Base class of data sources with `LazyScenes`. The `__init__` of a subclass must set `splits`.

    splits: the scenes of "train" and of "test".
    """

    splits: Mapping[Split, LazyScenes]

    def scenes(self, split: Split) -> LazyScenes:
        """Return the scenes of a split, without opening them."""
        return self.splits[split]

    def names(self, split: Split) -> Sequence[str]:
        """Return the names of the scenes of a split."""
        return self.scenes(split).names


def resized(source: SceneSource, config: SceneSourceConfig, size: Size) -> SceneSource:
    """Return `source` opened again, with the options `config` and images of size (H, W)."""
    return type(source)(config.model_copy(update={"image_size": size}))
