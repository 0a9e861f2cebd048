"""Evaluation indices, compared with the scenes that a data set holds."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass

from upath import UPath

from qgs.evaluate.plan import GIVEN, IndexEntry, given_targets, read_index
from qgs.paths import read_json
from qgs_photos.datatools.findings import Finding, spans


@dataclass(frozen=True)
class Held:
    """A scene that is there. split: empty where the format has none. frames: None if unreadable."""

    split: str
    frames: int | None


def found_indices(path: UPath) -> list[UPath]:
    """Return the JSON files in the folder `path` that have the form of an evaluation index."""
    files = path.iterdir() if path.is_dir() else ()
    return sorted((file for file in files if file.suffix == ".json" and _is_index(file)), key=str)


def _is_index(file: UPath) -> bool:
    try:
        data = read_json(file, "")
    except (OSError, ValueError):
        return False
    entries = data.values() if isinstance(data, dict) else ()
    return any(isinstance(e, dict) and {"context", "target"} <= e.keys() for e in entries)


def index_findings(
    file: UPath, scenes: Mapping[str, Sequence[Held]], reported: Container[str] = ()
) -> tuple[list[Finding], str | None]:
    """Return findings on entries that neither exist nor are `reported`, and a line on the index.

    The line is None where the file is no index.
    """
    try:
        index = read_index(str(file))
    except ValueError as error:
        return [Finding(file.name, str(error), "correct the file, or get it again")], None
    findings: list[Finding] = []
    for name, entry in index.items():
        if entry is not None and (name in scenes or name not in reported):
            findings += _entry_findings(file.name, name, entry, scenes.get(name, ()))
    # scenes that are never judged
    null = sum(entry is None for entry in index.values())
    return findings, f"{file}: {len(index)} scenes, {null} of them without frames (null)"


def _entry_findings(
    file: str, name: str, entry: IndexEntry, held: Sequence[Held]
) -> Iterator[Finding]:
    if not held:
        fix = "add the scene, or take it out of the index; correct the name if it is spelled wrong"
        yield Finding(name, f"the index {file} names the scene, which is not there", fix)
        return
    of_test = [scene for scene in held if scene.split != "train"]
    if not of_test:
        fix = "move it to the test split, or take it out of the index"
        yield Finding(name, f"the index {file} names the scene, which is in train only", fix)
    frames = (of_test or held)[0].frames
    if frames is None:
        return
    for role, numbers in (("context", entry.context), ("target", entry.target)):
        if outside := tuple(number for number in numbers if not 0 <= number < frames):
            yield Finding(
                name,
                f"the index {file} has the {role} frame{'s' if len(outside) > 1 else ''} "
                f"{spans(outside)}, but the scene's {frames} frames are 0 to {frames - 1}",
                "correct the index, or add the missing frames to the scene",
                outside,
            )
    if given := given_targets(entry.context, entry.target):
        fix = "judge models on frames that they are not given"
        yield Finding(name, f"the index {file} has {GIVEN}", fix, given, severity="warning")
