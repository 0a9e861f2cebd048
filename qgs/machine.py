"""Memory and cores of this machine: available bytes, errors for lack of memory, work in threads."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import psutil
import torch
from rich.filesize import decimal


class TooLargeError(ValueError):
    """Error for a request that does not fit into memory."""


def refuse_more_than_memory(what: str, needed: int, advice: str) -> None:
    """Raise TooLargeError if `needed` bytes, a lower bound, exceed the available memory.

    what: name of the request, the subject of the message. advice: sentence that ends the message.
    """
    limit = available_bytes()
    if needed > limit:
        raise TooLargeError(
            f"{what} takes at least {decimal(needed)} of memory, but {decimal(limit)} are "
            f"available. {advice}"
        )


def available_bytes() -> int:
    """Return the number of bytes of memory that this process can still use.

    This is the lower of two limits: that of the machine, and that of the process's control group
    (container).
    """
    limits = [psutil.virtual_memory().available + psutil.swap_memory().free]
    # A container sees its own control group at this path.
    group = Path("/sys/fs/cgroup")
    # No group, or none with a limit.
    with suppress(OSError, ValueError, KeyError):
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        rows = (group / "memory.stat").read_text().splitlines()
        # the system frees cached files on demand
        cached = dict(row.split() for row in rows)["inactive_file"]
        limits.append(limit - used + int(cached))
    return max(0, min(limits))


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether `error` says that Python, NumPy or torch ran out of memory, on any device."""
    words = str(error).lower()
    from_torch = "can't allocate memory" in words or "out of memory" in words
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and from_torch)


def in_threads(unit: Callable[..., None], work: Iterable[tuple[Any, ...]]) -> None:
    """Call `unit(*item)` for every item of `work` in threads, and wait for all calls.

    The order of the calls is undefined, so every call must write to memory of its own. `unit` must
    not call `in_threads`: it could wait forever for threads that are in use.
    """
    futures = [_threads(torch.get_num_threads()).submit(unit, *item) for item in work]
    # Waits for all even if one fails: no thread writes after this returns.
    wait(futures)
    for future in futures:
        future.result()


@lru_cache(maxsize=1)
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="qgs-kernel")


# Threads do not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
