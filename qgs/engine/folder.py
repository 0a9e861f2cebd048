"""The folder of one training run; nothing in it is ever overwritten by another run."""

import fcntl
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from qgs.io.files import is_leftover, read_records, told_where_full, write_text
from qgs.io.models import CHECKPOINT


class FolderGoneError(OSError):
    """The folder of a run is not there any more; the message says what becomes of the run."""


class RunFolder:
    """The files of a run, whether they exist yet or not.

    checkpoint: the latest good weights; checkpoint_ema: their moving average, where a recipe asks
    for it; state: everything that continues the run; evaluation: where `qgs eval` writes.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.recipe = self.path / "recipe.yaml"
        self.checkpoint = self.path / CHECKPOINT
        self.checkpoint_ema = self.path / "checkpoint_ema.safetensors"
        self.state = self.path / "state.safetensors"
        self.evaluation = self.path / "evaluation"
        self._history_file = self.path / "history.jsonl"
        self._history: TextIO | None = None
        self._lock: int | None = None
        self._taken: tuple[int, int] | None = None

    @property
    def is_new(self) -> bool:
        """Whether the folder does not exist or holds nothing but what killed processes left."""
        return not self.path.is_dir() or all(map(is_leftover, self.path.iterdir()))

    def refuse_other(self, resume: bool) -> None:
        """Raise FileExistsError unless the path is new or, with `resume`, holds a run."""
        if self.path.is_file():
            raise FileExistsError(f"{self.path} is a file; choose another folder for this run")
        if self.is_new or (resume and self.state.is_file()):
            return
        if not resume:
            raise FileExistsError(
                f"{self.path} is not empty and a run never overwrites another; choose another "
                "folder, delete it yourself, or continue its run with --resume"
            )
        if self.checkpoint.exists():
            raise FileExistsError(
                f"{self.state} is missing or no file, so the run whose {self.checkpoint.name} is "
                "there cannot be continued, and starting again would overwrite it; choose another "
                "folder"
            )
        if not self.recipe.is_file():
            raise FileExistsError(
                f"{self.path} is not empty and holds no run of `qgs train`; choose another folder"
            )

    def take(self) -> None:
        """Lock the folder for this process until `close`; delete temporary files of killed ones.

        Raises FileExistsError while another process trains in it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        if self._lock is None:
            self._lock = os.open(self.path, os.O_RDONLY)
            try:  # the system takes the lock off a dead process
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self.close()
                raise FileExistsError(
                    f"another process is training in {self.path}; wait for its end, or choose "
                    "another folder"
                ) from None
            except OSError:
                self.close()  # this file system knows no locks
        self._taken = (found := self.path.stat()).st_dev, found.st_ino
        for leftover in filter(is_leftover, self.path.iterdir()):
            leftover.unlink()

    def append(self, record: Mapping[str, float]) -> None:
        """Add one line to the history."""
        self.refuse_gone()
        with told_where_full(self._history_file):
            if self._history is None:
                self._history = self._history_file.open("a", encoding="utf-8")
            self._history.write(json.dumps(record) + "\n")

    def refuse_gone(self) -> None:
        """Raise FolderGoneError when the folder that was taken is no longer at its path."""
        if self._taken is None:
            return
        there = self.path.stat() if self.path.is_dir() else None
        if there is None or (there.st_dev, there.st_ino) != self._taken:
            raise FolderGoneError(
                f"{self.path} was deleted, moved or replaced while a training wrote into it, so "
                "the training stops; nothing is written in its place"
            )

    def flush(self, to_disk: bool = False) -> None:
        """Let others read the history so far; to_disk: also see that it outlives the system."""
        self.refuse_gone()
        if self._history is not None:
            with told_where_full(self._history_file):
                self._history.flush()
                if to_disk:
                    os.fsync(self._history.fileno())

    def history(self) -> list[dict[str, float]]:
        """All records so far, one per optimiser step; of one left out, finite numbers."""
        self.flush()
        return read_records(self._history_file)

    def cut_history(self, step: int) -> None:
        """Drop the records of later steps than `step`, and lines that are damaged."""
        if self._history_file.exists():
            kept = [record for record in self.history() if record["step"] <= step]
            write_text(self._history_file, "".join(json.dumps(record) + "\n" for record in kept))

    def close(self) -> None:
        """Close the history and leave the folder to others."""
        if self._history is not None:
            with suppress(OSError):  # a full disk, of which its last flush has told
                self._history.close()
        if self._lock is not None:
            os.close(self._lock)
        self._history = self._lock = None
