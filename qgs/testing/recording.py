"""Tensors that note when their numbers are read, and fields that note when they are asked for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from qgs import types
from qgs.testing.trees import mapped
from qgs.types import LayerPrediction, QueryState

METADATA = {
    getattr(Tensor, name).__get__
    for name in (
        "shape",
        "dtype",
        "device",
        "ndim",
        "requires_grad",
        "layout",
        "is_cuda",
        "grad_fn",
    )
} | {Tensor.size, Tensor.dim, Tensor.numel, Tensor.__len__, Tensor.is_floating_point}
"""What can be asked of a tensor without reading a number of it."""

PASSING_ON = {
    function.__code__
    for function in (
        QueryState.__post_init__,
        QueryState.replace,
        types._items,
    )
}
"""Code that goes through all fields for the component, which sees none of them."""


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
    """A tensor that adds `read_as` to `readers` as soon as anything is computed of it."""

    read_as: str
    readers: set[str]

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note the read; results are plain tensors, but for copies elsewhere or in a dtype."""
        read = func not in METADATA and func is not Tensor.to

        def plain(value: Any) -> Any:
            if not isinstance(value, RecordedTensor):
                return value
            if read:
                value.readers.add(value.read_as)
            with torch._C.DisableTorchFunctionSubclass():
                return value.as_subclass(Tensor)

        given = func(*tree_map(plain, args), **tree_map(plain, kwargs or {}))
        moved = func is Tensor.to and isinstance(args[0], RecordedTensor)
        return args[0].again(given) if moved else given

    def again(self, moved: Tensor) -> RecordedTensor:
        """The same numbers on another device or in another dtype, which count as this tensor's."""
        return _noted(moved, self.read_as, self.readers)


def _noted(tensor: Tensor, name: str, readers: set[str]) -> RecordedTensor:
    note = tensor.as_subclass(RecordedTensor)
    note.read_as, note.readers = name, readers
    return note


class RecordedFields(Mapping[str, Tensor]):
    """Fields of a state that note who asks, and have whatever is asked for.

    absent: makes the tensor of a field that is not there.
    """

    def __init__(
        self, held: Mapping[str, Tensor], absent: Callable[[str], Tensor], reads: Reads
    ) -> None:
        self._held = dict(held)
        self._absent = absent
        self._reads = reads

    def changed(self, fields: Mapping[str, Tensor]) -> RecordedFields:
        """With other fields besides or instead."""
        return RecordedFields({**self._held, **fields}, self._absent, self._reads)

    def to(self, *args: Any, **kwargs: Any) -> RecordedFields:
        """With every field moved; none of them is looked at."""
        moved = {name: tensor.to(*args, **kwargs) for name, tensor in self._held.items()}
        return RecordedFields(
            moved, lambda name: self._absent(name).to(*args, **kwargs), self._reads
        )

    def __getitem__(self, name: str) -> Tensor:
        """The field, held or made up; `get` and `in` come here too."""
        if not isinstance(name, str):
            raise KeyError(name)
        if sys._getframe(1).f_code not in PASSING_ON:
            self._reads.asked.add(name)
        return self._held[name] if name in self._held else self._absent(name)

    def __or__(self, fields: Mapping[str, Tensor]) -> RecordedFields:
        """As of the dict that a state usually holds; none of its fields is looked at."""
        return self.changed(fields)

    def __iter__(self) -> Iterator[str]:
        return iter(self._every(sys._getframe(1).f_code))

    def __len__(self) -> int:
        return len(self._every(sys._getframe(1).f_code))

    def keys(self) -> Any:
        """All names."""
        return self._every(sys._getframe(1).f_code).keys()

    def values(self) -> Any:
        """All tensors."""
        return self._every(sys._getframe(1).f_code).values()

    def items(self) -> Any:
        """All of both."""
        return self._every(sys._getframe(1).f_code).items()

    def _every(self, asker: Any) -> dict[str, Tensor]:
        self._reads.all_asked |= asker not in PASSING_ON
        return self._held


class RecordedState(QueryState):
    """A state whose copies note who asks for their fields, as it does itself."""

    fields: RecordedFields  # pyright: ignore[reportIncompatibleVariableOverride]

    def replace(
        self, features: Tensor | None = None, fields: Mapping[str, Tensor] | None = None
    ) -> QueryState:
        """As of any state."""
        kept = self.features if features is None else features
        return RecordedState(kept, self.fields.changed(fields or {}))

    def to(self, *args: Any, **kwargs: Any) -> RecordedState:
        """As of any state."""
        return RecordedState(self.features.to(*args, **kwargs), self.fields.to(*args, **kwargs))


def recorded(inputs: dict[str, Any], absent: Callable[[str], Tensor]) -> tuple[Any, Reads]:
    """A copy of the inputs of a component, and what was looked at in it so far.

    absent: makes a field that a component asks for and that `inputs` lack.
    """
    reads = Reads()

    def wrap(name: str, tensor: Tensor) -> Tensor:
        return _noted(tensor.detach().clone(), name, reads.numbers)

    def watched(value: Any) -> Any:
        if isinstance(value, QueryState):
            return RecordedState(value.features, RecordedFields(value.fields, absent, reads))
        if isinstance(value, LayerPrediction):
            return replace(value, state=watched(value.state))
        return value

    copy = {name: watched(value) for name, value in mapped(inputs, wrap).items()}
    reads.numbers.clear()
    return copy, reads
