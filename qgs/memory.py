"""How much memory there is, refusing what cannot fit into it, and telling that it ran out."""

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

_FILES_1 = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
_FILES_2 = "memory.max", "memory.current", "inactive_file"
"""Of a control group of version 1 and 2: files of its limit and use, and what of memory.stat the
system gives back when asked."""


class TooLargeError(ValueError):
    """What was asked for does not fit into memory; the message has the numbers."""


def refuse_beyond_memory(
    what: str, needed: Mapping[str, int], advice: str, available: int | None = None
) -> None:
    """Raise TooLargeError when the sum of `needed` is more than the memory that is available.

    needed: bytes, of what: a lower bound will do. available: bytes; None for this machine's.
    """
    total = sum(needed.values())
    limit = available_bytes() if available is None else available
    if total > limit:
        parts = sorted(needed.items(), key=lambda part: -part[1])[:3]
        raise TooLargeError(
            f"{what} takes {in_words(total)} of memory at least, and {in_words(limit)} are "
            f"available: {', '.join(f'{name} {in_words(size)}' for name, size in parts)}. {advice}"
        )


def available_bytes() -> int:
    """Memory that this process can still take: the machine's, its container's, its own limit."""
    limits = [sys.maxsize]
    with suppress(OSError, ValueError, KeyError):  # no Linux
        lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        sizes = {line[0]: int(line[1]) * 1024 for line in lines}
        limits.append(sizes["MemAvailable:"] + sizes["SwapFree:"])
    if len(limits) == 1:
        with suppress(ValueError, OSError):  # a system that does not tell
            limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    limits += _left_by_groups(Path("/"))
    with suppress(ImportError, OSError, ValueError):
        import resource  # Windows has none

        own, _ = resource.getrlimit(resource.RLIMIT_AS)
        if own != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limits.append(own - pages * os.sysconf("SC_PAGE_SIZE"))
    return max(0, min(limits))


def _left_by_groups(root: Path) -> Iterator[int]:
    """What each control group with a limit, of this process or above it, leaves to it, in bytes."""
    member = root / "proc/self/cgroup"
    lines = member.read_text().splitlines() if member.is_file() else []
    for kinds, inside in (line.split(":", 2)[1:] for line in lines):
        if kinds and "memory" not in kinds.split(","):
            continue
        top = root / "sys/fs/cgroup" / ("memory" if kinds else "")
        limit, taken, given_back = _FILES_1 if kinds else _FILES_2
        groups = [top / inside.strip("/"), *(top / inside.strip("/")).parents]
        for group in groups[: groups.index(top) + 1]:
            with suppress(OSError, ValueError, KeyError):  # no limit, or a path seen from inside
                stat = (group / "memory.stat").read_text().splitlines()
                used = int((group / taken).read_text())
                used -= int(dict(row.split() for row in stat)[given_back])
                yield int((group / limit).read_text()) - used


def is_out_of_memory(error: BaseException) -> bool:
    """Whether Python, NumPy or torch, on any device, found no memory."""
    words = str(error).lower()
    from_torch = "can't allocate memory" in words or "out of memory" in words
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and from_torch)


def in_words(size: int) -> str:
    """Bytes as people write them: 1.5 GB."""
    units = ("bytes", "kB", "MB", "GB", "TB", "PB")
    power = min((len(str(abs(size))) - 1) // 3, len(units) - 1)
    return f"{size / 1000**power:.3g} {units[power]}"
