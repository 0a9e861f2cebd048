"""The folder of one training run; nothing in it is ever overwritten by another run."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO

from qgs.composer import Recipe
from qgs.composer.recipe import annotated
from qgs.io.files import is_leftover, read_records, write_text


class RunFolder:
    """RUN: recipe.yaml, history.jsonl, checkpoint.safetensors, state.safetensors, evaluation/.

    checkpoint.safetensors is the model, for users; state.safetensors alone continues the run.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._history: TextIO | None = None
        self._lock: int | None = None

    def refuse_used(self) -> None:
        """Raise FileExistsError when the path is a file or a folder that holds anything."""
        self._refuse_file()
        if not self.is_new:
            raise FileExistsError(
                f"{self.path} is not empty and a run never overwrites another; choose another "
                "folder, delete it yourself, or continue its run with --resume"
            )

    def refuse_foreign(self) -> None:
        """Raise FileExistsError when the path holds something, but no run to be continued."""
        self._refuse_file()
        if self.is_new or self.state.is_file():
            return
        if self.checkpoint.exists():
            raise FileExistsError(
                f"{self.path} holds a checkpoint but no {self.state.name}, so its run cannot be "
                "continued, and starting again would overwrite it; choose another folder"
            )
        if not self.recipe.is_file():
            raise FileExistsError(
                f"{self.path} is not empty and holds no run of `qgs train`; choose another folder"
            )

    def _refuse_file(self) -> None:
        if self.path.is_file():
            raise FileExistsError(f"{self.path} is a file; choose another folder for this run")

    @property
    def is_new(self) -> bool:
        """Whether the folder does not exist or holds nothing but what killed processes left."""
        return not self.path.is_dir() or all(map(is_leftover, self.path.iterdir()))

    @property
    def recipe(self) -> Path:
        """The resolved recipe."""
        return self.path / "recipe.yaml"

    @property
    def checkpoint(self) -> Path:
        """The latest good weights."""
        return self.path / "checkpoint.safetensors"

    @property
    def checkpoint_ema(self) -> Path:
        """The moving average of the weights, where a recipe asks for it."""
        return self.path / "checkpoint_ema.safetensors"

    @property
    def state(self) -> Path:
        """Everything that continues the run."""
        return self.path / "state.safetensors"

    @property
    def evaluation(self) -> Path:
        """Where `qgs eval` writes."""
        return self.path / "evaluation"

    def take(self) -> None:
        """Make the folder this process's own until `close`; remove what killed ones left half done.

        Raises FileExistsError while another process trains in it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        if self._lock is None:
            self._lock = _locked(self.path)
        for leftover in filter(is_leftover, self.path.iterdir()):
            leftover.unlink()

    def write_recipe(self, recipe: Recipe) -> None:
        """Write the resolved recipe; comments say what set each value."""
        write_text(self.recipe, annotated(recipe) + "\n")

    def append(self, record: Mapping[str, float]) -> None:
        """Add one line to the history."""
        if self._history is None:
            self._history = self._history_file.open("a", encoding="utf-8")
        self._history.write(json.dumps(record) + "\n")

    def flush(self) -> None:
        """Let others read the history so far."""
        if self._history is not None:
            self._history.flush()

    def synchronise(self) -> None:
        """Bring the history to the disk."""
        if self._history is not None:
            self._history.flush()
            os.fsync(self._history.fileno())

    def history(self) -> list[dict[str, float]]:
        """All records so far, one per optimiser step.

        A step that was left out is `skipped`, and tells only those of its numbers that are finite.
        """
        self.flush()
        return read_records(self._history_file)

    def cut_history(self, step: int) -> None:
        """Drop the records of later steps than `step`, and lines that are damaged."""
        if not self._history_file.exists():
            return
        kept = (record for record in read_records(self._history_file) if record["step"] <= step)
        write_text(self._history_file, "".join(json.dumps(record) + "\n" for record in kept))

    def close(self) -> None:
        """Close the history and leave the folder to others."""
        if self._history is not None:
            self._history.close()
            self._history = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def _history_file(self) -> Path:
        return self.path / "history.jsonl"


def checkpoint_of(path: str | Path) -> Path:
    """The checkpoint file that `path`, a run folder or the file itself, stands for.

    Raises FileNotFoundError.
    """
    file = RunFolder(path).checkpoint if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise FileNotFoundError(
            f"no checkpoint at {file}; give a run folder of `qgs train` or a .safetensors file"
        )
    return file


def _locked(folder: Path) -> int | None:
    """A descriptor of `folder` that keeps others out; the system takes the lock off a dead process.

    None where the file system knows no locks. Raises FileExistsError.
    """
    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(number)
        raise FileExistsError(
            f"another process is training in {folder}; wait for its end, or choose another folder"
        ) from None
    except OSError:
        os.close(number)
        return None
    return number
