"""Reader of result folders that `qgs eval` writes."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qgs.contracts import Column
from qgs.evaluate.protocol import Protocol
from qgs.evaluate.results import METHODS
from qgs.recipe.errors import Problems
from qgs.recipe.yaml_text import load_mapping


@dataclass(frozen=True)
class StoredResults:
    """Results of one evaluation, read from a folder.

    name: path of the folder as given. columns: table format of each metric. scenes: for each scene,
    its values by name, such as "model_psnr". frames: input and target frames of each scene.
    missing: scenes without a score. step: number of training steps. recipe: recipe of the training
    as JSON, with defaults filled in, without seed and evaluation; "" if unknown. seed: seed of the
    training. step and seed are None if unknown. trained: facts about the training, such as data and
    duration.
    """

    name: str
    protocol: Protocol
    columns: Mapping[str, Column]
    scenes: Mapping[str, Mapping[str, float]]
    frames: Mapping[str, tuple[str, str]]
    missing: Sequence[str] = ()
    step: int | None = None
    recipe: str = ""
    seed: int | None = None
    trained: Mapping[str, str] = field(default_factory=dict)


def common_scenes(results: Sequence[StoredResults]) -> list[str]:
    """Return the scenes that occur in each of `results`, in the order of the first result."""
    first = results[0].scenes if results else {}
    return [scene for scene in first if all(scene in one.scenes for one in results)]


def moved_scenes(results: Sequence[StoredResults]) -> list[str]:
    """Return the scenes that occur in each of `results`, but with different frames."""
    # A protocol that draws views names no frames; they depend on the data.
    scenes = common_scenes(results)
    return [scene for scene in scenes if len({one.frames[scene] for one in results}) > 1]


def read_results(path: str | Path) -> StoredResults:
    """Read results from a folder that `qgs eval` wrote, or from a run folder with `evaluation/`.

    Raises FileNotFoundError if there are no results, and ValueError if they cannot be read.
    """
    # `path` is a folder of `qgs eval`, or the run folder of a training.
    folders = (Path(path), Path(path) / "evaluation")
    folder = next((folder for folder in folders if (folder / "summary.json").is_file()), None)
    if folder is None:
        raise FileNotFoundError(
            f"no results in {path}; give a folder that `qgs eval` wrote, or a run folder that "
            "contains evaluation/"
        )
    try:
        return _read(folder, str(path))
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"the results in {folder} cannot be read ({type(error).__name__}: {error}); evaluate "
            "again with `qgs eval`"
        ) from error


def _read(folder: Path, name: str) -> StoredResults:
    summary = json.loads((folder / "summary.json").read_bytes())
    protocol = json.loads((folder / "protocol.json").read_bytes())
    scenes: dict[str, dict[str, float]] = {}
    frames: dict[str, tuple[str, str]] = {}
    with (folder / "scenes.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            # A scene without a score also has a row.
            if row.pop("problem"):
                continue
            scene = row["scene"]
            frames[scene] = (row["input_frames"], row["target_frames"])
            scenes[scene] = {k: float(v) for k, v in row.items() if k.startswith(METHODS) and v}
    return StoredResults(
        name=name,
        protocol=Protocol(summary["protocol"]["name"], protocol),
        columns={column: Column(**facts) for column, facts in summary["columns"].items()},
        scenes=scenes,
        frames=frames,
        missing=list(summary["missing"]),
        step=summary["step"],
        **_training(folder.parent / "recipe.yaml"),
    )


def _training(recipe: Path) -> dict[str, Any]:
    """Return the fields recipe, seed and trained of `StoredResults`, read from a recipe file.

    The recipe must have its defaults filled in. The result is empty if the file does not exist.
    """
    if not recipe.is_file():
        return {}
    tree = load_mapping(recipe.read_text(encoding="utf-8"), str(recipe), Problems())
    # Trainings that differ only in these values are one side of a comparison.
    seed = tree.pop("seed")
    del tree["evaluation"]
    names = ("steps", "seconds", "batch_size")
    trained = {name: str(tree["training"][name]) for name in names}
    trained["data"] = json.dumps(tree.get("data"))
    return {"recipe": json.dumps(tree), "seed": seed, "trained": trained}
