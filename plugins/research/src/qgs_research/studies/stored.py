"""Results that `qgs eval` wrote, read back."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box

from qgs.contracts import Column
from qgs.evaluate.protocol import Protocol
from qgs.evaluate.results import FRAME_COLUMNS, NAME_COLUMNS
from qgs.recipe.errors import Problems
from qgs.recipe.yaml_text import load_mapping

COMPACT: Mapping[str, Any] = {"box": box.SIMPLE_HEAD, "collapse_padding": True, "pad_edge": False}
"""How tables are printed."""


@dataclass(frozen=True)
class StoredResults:
    """Results of one evaluation. name: the folder, as it was given.

    scenes: `SceneScore.values` of the evaluated scenes. frames: their input and target frames, as
    scenes.csv writes them. wanted: number of scenes of the protocol. columns, missing, null and
    step as in `Evaluation`. recipe, seed, budget: of a run folder; its resolved recipe as JSON
    without seed and evaluation. runs: the trainings whose mean this is; empty for a single one.
    """

    name: str
    protocol: Protocol
    columns: Mapping[str, Column]
    scenes: Mapping[str, Mapping[str, float]]
    frames: Mapping[str, tuple[str, str]]
    wanted: int
    missing: Sequence[str] = ()
    null: Sequence[str] = ()
    step: int | None = None
    recipe: str = ""
    seed: int | None = None
    budget: str = ""
    runs: Sequence["StoredResults"] = ()

    @property
    def trainings(self) -> Sequence["StoredResults"]:
        """`runs`, or the single one that this is."""
        return self.runs or [self]


def read_results(path: str | Path) -> StoredResults:
    """Results in `path`: a folder that `qgs eval` wrote, or a run folder with an evaluation/.

    Raises FileNotFoundError when there are none, ValueError when they cannot be read.
    """
    folders = (Path(path), Path(path) / "evaluation")
    folder = next((folder for folder in folders if (folder / "summary.json").is_file()), None)
    if folder is None:
        raise FileNotFoundError(
            f"no results in {path}; give a folder that `qgs eval` wrote, or a run folder with an "
            "evaluation/ in it"
        )
    try:
        summary, content = (
            json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
            for name in ("summary", "protocol")
        )
        with (folder / "scenes.csv").open(encoding="utf-8", newline="") as file:
            rows = {row["scene"]: row for row in csv.DictReader(file) if not row["problem"]}
        no_values = (*FRAME_COLUMNS, *NAME_COLUMNS)
        return StoredResults(
            name=str(path),
            protocol=Protocol(summary["protocol"]["name"], content),
            columns={name: Column(**column) for name, column in summary["columns"].items()},
            scenes={
                scene: {k: float(v) for k, v in row.items() if k not in no_values and v}
                for scene, row in rows.items()
            },
            frames={s: (row["input_frames"], row["target_frames"]) for s, row in rows.items()},
            wanted=summary["scenes_in_protocol"],
            missing=list(summary["missing"]),
            null=summary["null_entries"],
            step=summary["step"],
            **_training(folder.parent / "recipe.yaml"),
        )
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"the results in {folder} cannot be read ({type(error).__name__}: {error}); evaluate "
            "again with `qgs eval`"
        ) from error


def _training(recipe: Path) -> dict[str, Any]:
    """Recipe, seed and budget of the run whose resolved recipe is in the file; {} without it."""
    if not recipe.is_file():
        return {}
    tree = load_mapping(recipe.read_text(encoding="utf-8"), str(recipe), Problems())
    seed, training, _ = tree.pop("seed"), tree["training"], tree.pop("evaluation")
    seconds = training["seconds"]
    budget = f"{seconds:g} s" if seconds else f"{training['steps']:,} steps"
    return {"recipe": json.dumps(tree), "seed": seed, "budget": budget}
