"""Compare evaluation indices with the scenes of a data set."""

from collections.abc import Iterator, Sequence
from contextlib import suppress

from upath import UPath

from qgs.evaluate.plan import read_index
from qgs.paths import listing, read_json
from qgs_photos.datatools.findings import Finding, SceneReport, spans


def found_indices(path: UPath) -> Iterator[UPath]:
    """Yield the JSON files in the folder `path` that have the form of an evaluation index."""
    for file in sorted(listing(path), key=str):
        # other JSON files may be anything
        with suppress(OSError, ValueError):
            data = read_json(file, "") if file.suffix == ".json" else ()
            entries = data.values() if isinstance(data, dict) else ()
            if any(isinstance(e, dict) and {"context", "target"} <= e.keys() for e in entries):
                yield file


def index_findings(file: UPath, scenes: Sequence[SceneReport]) -> Iterator[Finding]:
    """Yield findings for scenes and frames of an index that the data set does not hold.

    file: the index. scenes: reports on the scenes of the data set; of test scenes with one name,
    the first counts.
    """
    try:
        index = read_index(str(file)) or {}
    except ValueError as error:
        yield Finding(file.name, str(error), "correct the file, or download it again")
        return
    shown = f"the index {file.name}"
    names = {scene.name for scene in scenes}
    tested = {scene.name: scene for scene in reversed(scenes) if scene.split != "train"}
    for name, entry in index.items():
        # scenes that are never judged have none
        if entry is None:
            continue
        if name not in tested:
            where = "is in train only" if name in names else "does not exist"
            fix = "add it to the test split, remove it from the index, or correct its name"
            yield Finding(name, f"{shown} names the scene, which {where}", fix)
            continue
        frames = tested[name].numbered
        outside = [n for n in (*entry.context, *entry.target) if not 0 <= n < frames]
        # of a scene that cannot be read that is told already
        if frames and outside:
            reason = f"{shown} has frames {spans(outside)}, but the scene has 0 to {frames - 1}"
            fix = "correct the index, or add the missing frames to the scene"
            yield Finding(name, reason, fix)
        if given := sorted({*entry.context}.intersection(entry.target)):
            reason = f"{shown} has frames as context and as target: {spans(given)}"
            fix = "score models on frames that are not inputs"
            yield Finding(name, reason, fix, severity="warning")
