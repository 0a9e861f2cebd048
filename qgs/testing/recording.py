"""Inputs that record what a component looks at: which numbers, and which fields of a state."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from qgs import types
from qgs.testing.trees import mapped
from qgs.types import LayerPrediction, QueryState

METADATA = {
    *(
        getattr(Tensor, name).__get__
        for name in ("shape", "dtype", "device", "ndim", "requires_grad", "layout", "grad_fn")
    ),
    *(Tensor.size, Tensor.dim, Tensor.numel, Tensor.__len__, Tensor.is_floating_point),
}
"""What can be asked of a tensor without reading a number of it."""

PASSING_ON = {f.__code__ for f in (QueryState.__post_init__, QueryState.replace, types._items)}
"""Code of the framework that goes through all fields on behalf of a component."""


@dataclass
class Reads:
    """What a component has looked at.

    numbers: dotted names of the tensors it computed with. asked: fields of a state that it asked
    for by name, found or not. all_asked: whether it went through the fields, names or values.
    """

    numbers: set[str] = field(default_factory=set)
    asked: set[str] = field(default_factory=set)
    all_asked: bool = False


class RecordedTensor(Tensor):
    """A tensor that adds `read_as` to `readers` as soon as anything is computed from it."""

    read_as: str
    readers: set[str]

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note the read. Results are plain tensors, except for copies by `Tensor.to`."""
        moved = func is Tensor.to and isinstance(args[0], RecordedTensor)
        read = func not in METADATA and not moved

        def plain(value: Any) -> Any:
            if not isinstance(value, RecordedTensor):
                return value
            if read:
                value.readers.add(value.read_as)
            with torch._C.DisableTorchFunctionSubclass():
                return value.as_subclass(Tensor)

        given = func(*tree_map(plain, args), **tree_map(plain, kwargs or {}))
        return _recorded(given, args[0].read_as, args[0].readers) if moved else given


def _recorded(tensor: Tensor, name: str, readers: set[str]) -> RecordedTensor:
    copy = tensor.as_subclass(RecordedTensor)
    copy.read_as, copy.readers = name, readers
    return copy


class RecordedFields(Mapping[str, Tensor]):
    """Fields of a state that record which of them are asked for."""

    def __init__(self, held: Mapping[str, Tensor], reads: Reads) -> None:
        self.held = dict(held)
        self.reads = reads

    def __or__(self, fields: Mapping[str, Tensor]) -> RecordedFields:
        """With other fields besides or instead, as of a dict; none is looked at."""
        return RecordedFields({**self.held, **fields}, self.reads)

    def __getitem__(self, name: str) -> Tensor:
        """One field; `get` and `in` come here too."""
        if not _is_passed_on():
            self.reads.asked.add(name)
        return self.held[name]

    def __iter__(self) -> Iterator[str]:
        self.reads.all_asked |= not _is_passed_on()
        return iter(self.held)

    def __len__(self) -> int:
        self.reads.all_asked |= not _is_passed_on()
        return len(self.held)


def _is_passed_on() -> bool:
    """Whether the framework asks, rather than the component."""
    frame: Any = sys._getframe(2)
    while "_collections_abc" in frame.f_code.co_filename:
        frame = frame.f_back
    return frame.f_code in PASSING_ON


class RecordedState(QueryState):
    """A state whose copies record what is asked of their fields, as it does itself."""

    fields: RecordedFields  # pyright: ignore[reportIncompatibleVariableOverride]

    def replace(
        self, features: Tensor | None = None, fields: Mapping[str, Tensor] | None = None
    ) -> QueryState:
        """As of any state."""
        return RecordedState(
            self.features if features is None else features, self.fields | (fields or {})
        )

    def to(self, *args: Any, **kwargs: Any) -> RecordedState:
        """As of any state."""
        moved = {name: x.to(*args, **kwargs) for name, x in self.fields.held.items()}
        return RecordedState(self.features.to(*args, **kwargs), self.fields | moved)


def recorded(inputs: dict[str, Any]) -> tuple[dict[str, Any], Reads]:
    """A copy of the inputs of a component, and the record of what is looked at in it."""
    reads = Reads()

    def with_record(value: Any) -> Any:
        if isinstance(value, QueryState):
            return RecordedState(value.features, RecordedFields(value.fields, reads))
        if isinstance(value, LayerPrediction):
            return replace(value, state=with_record(value.state))
        return value

    copy = mapped(inputs, lambda name, x: _recorded(x.detach().clone(), name, reads.numbers))
    copy = {name: with_record(value) for name, value in copy.items()}
    reads.numbers.clear()
    return copy, reads
