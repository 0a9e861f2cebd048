"""Commands that a reader of a report may want next, with the models and photos at hand."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from qgs_viewer.contest import Entry
from qgs_viewer.demo import MODELS

SCENE = "shows the scene in the browser, to turn and to pick queries in"
REFINED = "reconstructs the scene and refines it for 30 s"


def next_commands(
    models: Sequence[str],
    entries: Sequence[Entry],
    target: Path,
    photos: str | None = None,
    size: str | None = None,
    scale: float | None = None,
) -> Mapping[str, str]:
    """Commands, as a shell takes them, and what each does.

    models: `entries` as a command line names them. target: the folder of the report; what the
    commands write goes there, since it is new. photos, size, scale: those of the report.
    """
    best = shlex.quote(models[_best(entries)])
    scene = shlex.quote(f"{target / 'scene'}")
    if photos is None:
        several = " ".join(map(shlex.quote, models))
        compare = f"qgs report {several} --photos PHOTOS"
        if tuple(models) == MODELS:
            compare = "qgs demo PHOTOS"
        return {
            compare: "compares models on a folder PHOTOS of your own, with camera poses",
            f"qgs reconstruct {best} PHOTOS --out {scene} --refine 30": REFINED,
            f"qgs view {best}": SCENE,
            "qgs recipes": "lists recipes, each a model to train or to change",
        }
    given = f"{best} {shlex.quote(photos)}"
    names = [*dict.fromkeys(score.scene for score in entries[0].evaluation.scores)]
    chosen = f" --scene {shlex.quote(names[0])}" if len(names) > 1 else ""
    chosen += f" --size {shlex.quote(size)}" if size else ""
    chosen += f" --scale {scale:g}" if scale else ""
    return {
        f"qgs reconstruct {given}{chosen} --out {scene} --refine 30": REFINED,
        f"qgs view {given}{chosen}": SCENE,
    }


def _best(entries: Sequence[Entry]) -> int:
    """The place of the entry with the best score in the first column; the first of equal ones."""
    name, column = next(iter(entries[0].evaluation.columns.items()))
    scores = [entry.contender.scores[name] for entry in entries]
    return scores.index(column.best(scores))
