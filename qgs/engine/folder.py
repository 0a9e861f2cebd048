"""The folder of one training run; nothing in it is ever overwritten by another run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Self, TextIO

from qgs.composer import Recipe
from qgs.composer.show import annotated
from qgs.io.atomic import write_text


class RunFolder:
    """RUN: recipe.yaml, history.jsonl, checkpoint.safetensors, state.safetensors, evaluation/."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._history: TextIO | None = None

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """A new folder at `path`; an empty one is taken as new. Raises as `refuse_used`."""
        folder = cls(path)
        folder.refuse_used()
        folder.path.mkdir(parents=True, exist_ok=True)
        return folder

    def refuse_used(self) -> None:
        """Raise FileExistsError when the path is a file or a folder that holds anything."""
        if self.path.is_file():
            raise FileExistsError(f"{self.path} is a file; choose another folder for this run")
        if self.path.is_dir() and any(self.path.iterdir()):
            raise FileExistsError(
                f"{self.path} is not empty and a run never overwrites another; choose another "
                "folder or delete it yourself"
            )

    @property
    def checkpoint(self) -> Path:
        """The latest good weights."""
        return self.path / "checkpoint.safetensors"

    @property
    def state(self) -> Path:
        """Everything that continues the run."""
        return self.path / "state.safetensors"

    @property
    def evaluation(self) -> Path:
        """Where `qgs eval` writes."""
        return self.path / "evaluation"

    def write_recipe(self, recipe: Recipe) -> None:
        """Write the resolved recipe; comments say what set each value."""
        write_text(self.path / "recipe.yaml", annotated(recipe) + "\n")

    def append(self, record: Mapping[str, float]) -> None:
        """Add one line to the history."""
        if self._history is None:
            self._history = (self.path / "history.jsonl").open("a", encoding="utf-8")
        self._history.write(json.dumps(record) + "\n")

    def flush(self) -> None:
        """Bring the history to disk."""
        if self._history is not None:
            self._history.flush()

    def history(self) -> list[dict[str, float]]:
        """All records so far, one per optimiser step."""
        self.flush()
        lines = (self.path / "history.jsonl").read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        """Close the history."""
        if self._history is not None:
            self._history.close()
            self._history = None


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
