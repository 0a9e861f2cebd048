"""Reading results back that `Evaluation.write` wrote."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class StoredResults:
    """Results of one evaluation. name: the folder, as it was given. protocol: its content.

    scenes: name to values as `SceneScore.values`, of the scenes that were judged. frames: their
    input and target frames, as scenes.csv writes them. wanted: how many scenes the protocol names.
    missing: those without a score. null: scenes that the index lists without frames.
    """

    name: str
    protocol_name: str
    sha256: str
    protocol: Mapping[str, Any]
    scenes: Mapping[str, Mapping[str, float]]
    frames: Mapping[str, tuple[str, str]]
    wanted: int
    missing: Sequence[str] = ()
    null: Sequence[str] = ()


def read_results(path: str | Path) -> StoredResults:
    """Results in `path`: a folder that `qgs eval` wrote, or a run folder whose evaluation/ it is.

    Raises FileNotFoundError when there are none, ValueError when they cannot be read.
    """
    folder = Path(path)
    if not (folder / "summary.json").is_file():
        folder = folder / "evaluation"
    if not (folder / "summary.json").is_file():
        raise FileNotFoundError(
            f"no results in {path}; give a folder that `qgs eval` wrote, or a run folder with an "
            "evaluation/ in it"
        )
    try:
        return _read(folder, str(path))
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"the results in {folder} cannot be read ({type(error).__name__}: {error}): they were "
            "changed, or written by an earlier version; evaluate again with `qgs eval`"
        ) from error


def _read(folder: Path, name: str) -> StoredResults:
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    protocol = json.loads((folder / "protocol.json").read_text(encoding="utf-8"))
    with (folder / "scenes.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    told = {"scene", "input_frames", "target_frames", "problem"}
    judged = {row["scene"]: row for row in rows if not row["problem"]}
    scenes = {
        scene: {key: float(value) for key, value in row.items() if key not in told}
        for scene, row in judged.items()
    }
    frames = {s: (row["input_frames"], row["target_frames"]) for s, row in judged.items()}
    stated = summary["protocol"]
    return StoredResults(
        name=name,
        protocol_name=stated["name"],
        sha256=stated["sha256"],
        protocol=protocol,
        scenes=scenes,
        frames=frames,
        wanted=summary["scenes_in_protocol"],
        missing=list(summary["missing"]),
        null=summary["null_entries"],
    )
