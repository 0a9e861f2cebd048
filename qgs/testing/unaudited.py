"""Functions that reach files from C++ or Rust, where Python raises no audit event of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any
from weakref import WeakSet

import safetensors
import torch

UNAUDITED: Mapping[str, Any] = {
    "safetensors.safe_open": safetensors.safe_open,
    "safetensors.serialize_file": safetensors.serialize_file,
    "torch.PyTorchFileReader": torch._C.PyTorchFileReader,
    "torch.PyTorchFileWriter": torch._C.PyTorchFileWriter,
    "torch.import_ir_module": torch._C.import_ir_module,
    "torch.from_file": torch.from_file,
}
"""Name of an audit event to the function that raises it while `audited`.

`safetensors.torch.load_file` and `save_file`, `torch.save`, `torch.load` and `torch.jit.load` come
down to these.
"""


def _raising(event: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        paths = [x for x in (*arguments, *options.values()) if isinstance(x, str | os.PathLike)]
        if paths:
            sys.audit(event, paths[0])
        return function(*arguments, **options)

    return call


_RAISING = {event: _raising(event, function) for event, function in UNAUDITED.items()}
_EVENT_OF = {id(f): event for fs in (UNAUDITED, _RAISING) for event, f in fs.items()}

_holders: list[tuple[ModuleType, str, str]] = []
"""Modules, the names by which they know one of these functions, and its event."""

_searched: WeakSet[ModuleType] = WeakSet()


@contextmanager
def audited() -> Iterator[None]:
    """Every call of these functions with a path raises an audit event, whoever imported them."""
    _put(_RAISING)
    try:
        yield
    finally:
        _put(UNAUDITED)


def _put(functions: Mapping[str, Any]) -> None:
    _search()
    for module, name, event in _holders:
        setattr(module, name, functions[event])


def _search() -> None:
    """Find what modules know the functions, among those imported since the last search."""
    for module in list(sys.modules.values()):
        if isinstance(module, ModuleType) and module not in _searched:
            _searched.add(module)
            for name, value in list(vars(module).items()):
                if id(value) in _EVENT_OF:
                    _holders.append((module, name, _EVENT_OF[id(value)]))
