"""Compare evaluation indices with the scenes of a data set."""

from collections.abc import Iterator, Mapping, Sequence

from upath import UPath

from qgs.evaluate.plan import IndexEntry, read_index
from qgs.paths import listing, read_json
from qgs_photos.datatools.findings import Finding, SceneReport, spans


def found_indices(path: UPath) -> list[UPath]:
    """Return the JSON files in the folder `path` that have the form of an evaluation index."""
    files = (file for file in listing(path) if file.suffix == ".json" and _is_index(file))
    return sorted(files, key=str)


def _is_index(file: UPath) -> bool:
    try:
        data = read_json(file, "")
    except (OSError, ValueError):
        return False
    entries = data.values() if isinstance(data, dict) else ()
    return any(isinstance(e, dict) and {"context", "target"} <= e.keys() for e in entries)


def index_findings(file: UPath, held: Mapping[str, Sequence[SceneReport]]) -> Iterator[Finding]:
    """Yield findings for scenes and frames of an index that the data set does not hold.

    file: the index. held: reports on the scenes of the data set by name; scenes may share a name.
    """
    try:
        index = read_index(str(file)) or {}
    except ValueError as error:
        yield Finding(file.name, str(error), "correct the file, or download it again")
        return
    for name, entry in index.items():
        # scenes that are never judged have none
        if entry is not None:
            yield from _entry_findings(f"the index {file.name}", name, entry, held.get(name, ()))


def _entry_findings(
    index: str, name: str, entry: IndexEntry, held: Sequence[SceneReport]
) -> Iterator[Finding]:
    of_test = [scene for scene in held if scene.split != "train"]
    if not of_test:
        where = "is in train only" if held else "does not exist"
        fix = "add it to the test split, remove it from the index, or correct its name"
        yield Finding(name, f"{index} names the scene, which {where}", fix)
        return
    frames = of_test[0].numbered
    outside = [n for n in (*entry.context, *entry.target) if not 0 <= n < frames]
    # of a scene that cannot be read that is told already
    if frames and outside:
        reason = f"{index} has frames {spans(outside)}, but the scene has 0 to {frames - 1}"
        fix = "correct the index, or add the missing frames to the scene"
        yield Finding(name, reason, fix)
    if given := sorted({*entry.context}.intersection(entry.target)):
        reason = f"{index} has frames as context and as target: {spans(given)}"
        fix = "score models on frames that are not inputs"
        yield Finding(name, reason, fix, severity="warning")
