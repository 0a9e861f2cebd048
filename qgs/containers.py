"""Base class of tensor containers, and functions on tensors of containers.

The functions check shapes, and list, map and concatenate tensors.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, Self, TypeVar, cast

import torch
from torch import Tensor

_C = TypeVar("_C")


class TensorContainer:
    """Base of frozen dataclasses whose fields are tensors, containers, or mappings of these."""

    def __init_subclass__(cls) -> None:
        """Set `__repr__` on every subclass, so that `dataclass` does not write one."""
        cls.__repr__ = TensorContainer.__repr__

    def __repr__(self) -> str:
        """Return shapes, dtypes and devices of the tensors, without values."""
        # Values of a million Gaussians would not help.
        parts = [f"{n}: {tuple(x.shape)} {x.dtype} {x.device}" for n, x in named_tensors(self)]
        lines = "\n  ".join(["", *parts])
        return f"{type(self).__name__}({lines}\n)"

    def replace(self, **changes: Any) -> Self:
        """Return a copy of the container in which the fields in `changes` are replaced."""
        return replace(cast(Any, self), **changes)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Apply `Tensor.to` to every tensor. A dtype converts all tensors, including cameras."""
        return map_tensors(lambda x: x.to(*args, **kwargs), self)


def map_tensors(function: Callable[[Tensor], Any], value: Any) -> Any:
    """Apply `function` to each tensor in containers, mappings, lists and tuples.

    A container, mapping, list or tuple in which no tensor changes is returned without a copy.
    """
    if isinstance(value, Tensor):
        return function(value)
    items = _items(value)
    # An unchanged part keeps its cache.
    mapped = [(name, map_tensors(function, item)) for name, item in items]
    if all(new is old for (_, new), (_, old) in zip(mapped, items, strict=True)):
        return value
    if isinstance(value, TensorContainer):
        return value.replace(**dict(mapped))
    if isinstance(value, Mapping):
        return dict(mapped)
    return getattr(value, "_make", type(value))([item for _, item in mapped])  # _make: namedtuple


def concatenated(parts: Sequence[_C], dim: int, join: Callable[..., Tensor] = torch.cat) -> _C:
    """Concatenate `parts`, containers or tuples of containers, tensor by tensor along `dim`.

    join: function of a list of tensors and `dim` that concatenates these tensors. Raises ValueError
        if a tensor is in some parts and missing (None) in others.
    """
    found = [dict(named_tensors(part)) for part in parts]
    for other in found:
        if some := sorted(other.keys() ^ found[0].keys()):
            raise ValueError(f"{', '.join(some)} must be in all concatenated parts or in none")
    joined = (join([tensors[name] for tensors in found], dim) for name in found[0])
    # `map_tensors` comes to the tensors in the order of their names.
    return map_tensors(lambda _: next(joined), parts[0])


def named_tensors(value: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield the dotted name and the tensor for all tensors that `map_tensors` finds in `value`.

    name: prefix of all names.
    """
    if isinstance(value, Tensor):
        yield name, value
    for key, item in _items(value):
        yield from named_tensors(item, f"{name}.{key}" if name else str(key))


def _items(value: Any) -> list[tuple[Any, Any]]:
    """Return the parts of `value` with their names or numbers; a value without parts has none."""
    if isinstance(value, TensorContainer):
        return [(f.name, getattr(value, f.name)) for f in fields(cast(Any, value)) if f.init]
    if isinstance(value, Mapping):
        return [*value.items()]
    return [*enumerate(value)] if isinstance(value, list | tuple) else []


def check_shapes(
    container: TensorContainer, known: Mapping[str, int] | None = None, /, **shapes: str
) -> None:
    """Raise ValueError unless the fields of `container` have `shapes`, such as "B N 3".

    A letter stands for one size, the same in all fields, and "..." for any leading axes, the same
    in all fields. known: required sizes, by letter. Fields that are None are not checked.
    """
    sizes: dict[str, Any] = dict(known or {})
    for name, spec in shapes.items():
        tensor = getattr(container, name)
        axes = spec.split()
        if tensor is None:
            continue
        given = shape = tuple(tensor.shape)
        # Counts as one axis, whose size is a tuple.
        if axes[0] == "...":
            leading = max(len(shape) - len(axes) + 1, 0)
            given = (shape[:leading], *shape[leading:])
        if len(given) != len(axes) or any(
            sizes.setdefault(axis, int(axis) if axis.isdecimal() else size) != size
            for axis, size in zip(axes, given, strict=True)
        ):
            wanted = []
            for axis in axes:
                size = sizes.get(axis, axis)
                wanted += size if isinstance(size, tuple) else [size]
            message = f"must have shape ({', '.join(map(str, wanted))}), got {shape}"
            if axes[0] == "B" and len(shape) == len(axes) - 1:
                message += "; add a leading dimension for a single scene"
            raise ValueError(f"{type(container).__name__}.{name} {message}")
