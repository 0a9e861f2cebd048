"""A bounded memory of what was made last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

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
