"""Kernels on as many threads as torch uses, and the cores that there are."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import torch


def can_compile() -> bool:
    """Whether numba is installed, which `qgs.kernels` needs."""
    return find_spec("numba") is not None


def usable_cores() -> int:
    """CPU cores that this process may use; all of the machine where the system does not say."""
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
    return len(allowed) or os.cpu_count() or 1


def in_threads(unit: Callable[..., None], work: Iterable[tuple[Any, ...]]) -> None:
    """Call `unit(*item)` for every item of `work`, and wait.

    Every unit of work writes to its own memory, so their order does not matter. A unit must not
    call this itself: it would wait for the threads that it holds.
    """
    items = list(work)
    if len(items) == 1:
        unit(*items[0])
    else:
        futures = [_threads(torch.get_num_threads()).submit(unit, *item) for item in items]
        wait(futures)  # all of them, also where one fails: nobody writes when this returns
        for future in futures:
            future.result()


@lru_cache(maxsize=1)
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="qgs-kernel")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_threads.cache_clear)
