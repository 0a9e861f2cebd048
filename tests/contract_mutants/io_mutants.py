"""A component that reaches outside of the process when it is built, in a way that its option names.

Nothing comes of it: what is reached for is not there.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from qgs.components import MlpFeedForward
from qgs.contracts import ModelDims

POOL = ThreadPoolExecutor(1)
NOWHERE = Path(os.devnull) / "nowhere"

WAYS: Mapping[str, tuple[Callable[[], Any], str]] = {
    "load_file": (lambda: load_file(NOWHERE), "safetensors.safe_open"),
    "safe_open": (lambda: safe_open(NOWHERE, "pt"), "safetensors.safe_open"),
    "save_file": (lambda: save_file({"x": torch.zeros(1)}, NOWHERE), "safetensors.serialize_file"),
    "load": (lambda: torch.load(NOWHERE, weights_only=True), "open"),
    "save": (lambda: torch.save({}, NOWHERE), "torch.PyTorchFileWriter"),
    "from_file": (lambda: torch.from_file(str(NOWHERE), size=1), "torch.from_file"),
    "write_code": (lambda: (NOWHERE / "made.py").write_text(""), "open"),
    "write_code_by_flags": (lambda: os.open(NOWHERE / "made.py", os.O_WRONLY), "open"),
    "open_in_a_thread": (lambda: POOL.submit(open, NOWHERE).result(), "open"),
    "makedirs": (lambda: os.makedirs(NOWHERE / "cache"), "os.mkdir"),
    "mkdtemp": (lambda: tempfile.mkdtemp(dir=NOWHERE), "os.mkdir"),
    "listdir": (lambda: os.listdir(NOWHERE), "os.listdir"),
    "scandir": (lambda: os.scandir(NOWHERE), "os.scandir"),
    "remove": (lambda: NOWHERE.unlink(), "os.remove"),
    "rename": (lambda: NOWHERE.rename("elsewhere"), "os.rename"),
    "rmdir": (lambda: NOWHERE.rmdir(), "os.rmdir"),
}
"""What to do, and the audit event that tells of it."""


class ReachesOut(MlpFeedForward):
    name: ClassVar[str] = "reaches_out"

    class Config(MlpFeedForward.Config):
        way: str

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        with suppress(Exception):
            WAYS[config.way][0]()
