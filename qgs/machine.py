"""Memory and cores of this machine: sizes that do not fit, work on all cores."""

import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from rich.filesize import decimal


class TooLargeError(ValueError):
    """A request that does not fit into memory; the message has the numbers."""


def refuse_more_than_memory(what: str, needed: int, advice: str) -> None:
    """Raise TooLargeError when `needed` bytes, a lower bound, are more than the available ones."""
    limit = available_bytes()
    if needed > limit:
        raise TooLargeError(
            f"{what} takes {decimal(needed)} of memory at least, and {decimal(limit)} are "
            f"available. {advice}"
        )


def available_bytes() -> int:
    """Memory that this process can still take, of the machine and of its control group."""
    limits = [sys.maxsize]
    with suppress(OSError, ValueError, KeyError):  # no Linux
        sizes = _numbers(Path("/proc/meminfo"))
        limits.append(1024 * (sizes["MemAvailable:"] + sizes["SwapFree:"]))
    # A container sees its own group there.
    group = Path("/sys/fs/cgroup")
    # No group, or none with a limit.
    with suppress(OSError, ValueError, KeyError):
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        # the system frees cached files on demand
        limits.append(limit - used + _numbers(group / "memory.stat")["inactive_file"])
    return max(0, min(limits))


def _numbers(table: Path) -> dict[str, int]:
    return {row.split()[0]: int(row.split()[1]) for row in table.read_text().splitlines()}


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether Python, NumPy or torch ran out of memory, on any device."""
    words = str(error).lower()
    from_torch = "can't allocate memory" in words or "out of memory" in words
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and from_torch)


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
        # All of them, also where one fails: nobody writes when this returns.
        wait(futures)
        for future in futures:
            future.result()


@lru_cache(maxsize=1)
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="qgs-kernel")


# Threads do not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
