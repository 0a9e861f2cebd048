"""Memory of a process, as Linux counts it."""

from pathlib import Path


def megabytes(field: str, process: int | str = "self") -> float:
    """A field of /proc/PROCESS/status, such as VmHWM, the peak resident size, in 10^6 bytes."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:")) * 1.024e-3
