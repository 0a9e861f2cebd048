"""What a measurement was made on."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import torch

import qgs


def describe(device: str, threads: int) -> dict[str, str | int]:
    """Names and versions without which a number says nothing."""
    return {
        "device": device,
        "processor": torch.cuda.get_device_name() if device == "cuda" else _processor(),
        "cores": os.cpu_count() or 0,
        "threads": threads,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "qgs": qgs.__version__,
    }


def _processor() -> str:
    """The CPU's name, where the system tells it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
