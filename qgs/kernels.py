"""Compiling functions with numba, and running them on as many threads as torch uses."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import torch


@lru_cache
def can_compile() -> bool:
    """Whether numba is installed (the extra `cpu`)."""
    return find_spec("numba") is not None


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` on first use, kept on disk where there is a place that can be written."""
    from numba import njit

    options = {
        "nogil": True,
        "error_model": "numpy",  # no branch on a division by zero
        "fastmath": {"contract", "reassoc", "arcp", "nsz"},
        # kernels from the cache share what they call, and may run another's build of it
        "forceinline": True,
    }
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no such place
        return njit(**options)(function)


def in_threads(unit: Callable[..., None], work: Iterable[tuple[Any, ...]]) -> None:
    """Call `unit(*item)` for every item of `work`, and wait.

    Every unit of work writes to its own memory, so their order does not matter.
    """
    items = list(work)
    if len(items) == 1:
        unit(*items[0])
    else:
        list(_threads(torch.get_num_threads()).map(lambda item: unit(*item), items))


@lru_cache(maxsize=1)
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="qgs-kernel")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_threads.cache_clear)
