"""Sentences on results: searched scales, chosen photos, and the commands that come next."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from qgs.domain import Domain, verdict
from qgs.reconstruction.scale import FoundScale
from qgs.wording import counted, listed
from qgs_viewer.options import MODELS

if TYPE_CHECKING:
    from qgs_viewer.comparison import Model, Result
    from qgs_viewer.scenes import ModelScenes

AUTO_SCALE = "Each scene is scaled until what its cameras look at is 1 away (views.scale: auto)."
SCENE = "shows the scene in the browser, to turn and to pick queries in"
RECONSTRUCTED = "reconstructs the scene, as a PLY file too"
REFINED = "fits its Gaussians to all photos"


def summary(found: Collection[FoundScale], option: str = "--scale FACTOR") -> str:
    """Return one line on the scales of one or several windows; `option` sets another scale."""
    first = next(iter(found))
    text = first.text
    if len(found) > 1:
        ordered = sorted(scale.factor for scale in found)
        mean = sum(scale.psnr for scale in found) / len(found)
        text = (
            f"scale {ordered[0]:.3g} to {ordered[-1]:.3g}, found on the inputs and photos beside "
            f"them in {len(found)} windows: {mean:.1f} dB"
        )
        if poor := sum(bool(scale.poor) for scale in found):
            text += f", no scale fits {counted(poor, 'window')}"
    text += f", in {sum(scale.seconds for scale in found):.1f} s"
    return f"{text}; {option} sets another" if option else text


def scale_remarks(models: Sequence[Model], option: str = "--scale FACTOR") -> Iterator[str]:
    """Yield a sentence for each model whose scales were searched; `option` sets another scale."""
    for model in models:
        if found := model.search.found.values():
            yield f"{model.name}: {summary(found, option)}."
    if models[0].recipe.views.scale == "auto":
        yield AUTO_SCALE


def domain_remarks(models: Sequence[Model], shown: Sequence[ModelScenes]) -> Iterator[str]:
    """Yield for each model how the first scene of a user's photos relates to its training."""
    for model, scenes in zip(models, shown, strict=True):
        if model.windows is None:
            continue
        found = Domain()
        sample = scenes.samples[0]
        found.see(sample.inputs.cameras, sample.targets.cameras)
        fixed = ["scale"] if model.search.found else []
        yield f"{model.name}: {verdict(model.network.trained_on or Domain(), found, fixed)}."


def remarks(results: Sequence[Result]) -> list[str]:
    """Return the remarks of all evaluations, each once with its models, and those on scales."""
    names: dict[str, list[str]] = {}
    for result in results:
        evaluation = result.evaluation
        missing = [f"{f.scene} is not judged: {f.reason}" for f in evaluation.missing]
        for remark in (*evaluation.remarks, *missing):
            # the same remark on three models stands once, with their names
            names.setdefault(remark, []).append(result.name)
    texts = [f"{', '.join(models)}: {remark}." for remark, models in names.items()]
    return [*chosen_windows(results[0]), *texts, *scale_remarks(results)]


def chosen_windows(result: Result) -> Iterator[str]:
    """Yield a line on each scene whose windows were chosen."""
    if result.windows is None:
        return
    for score in result.evaluation.scores:
        texts = []
        for inputs, targets in score.views:
            given = listed(score.names.get(frame, frame) for frame in inputs)
            judged = listed(score.names.get(frame, frame) for frame in targets)
            texts.append(f"{given} ({judged})")
        windows = "; ".join(texts)
        yield f"{score.scene}, inputs (held-out photos that are judged): {windows}"


def next_commands(
    names: Sequence[str],
    results: Sequence[Result],
    target: Path,
    photos: str | None = None,
    options: Sequence[str] = (),
) -> dict[str, str]:
    """Return commands that a reader may want next, as a shell takes them, and what each does.

    names: the models as a command line names them. target: the folder of the report; what the
    commands write goes there, since it is new. options: those of the report for its photos.
    """
    first, column = next(iter(results[0].evaluation.columns.items()))
    scores = [result.scores[first] for result in results]
    # of equal ones the first
    best = shlex.quote(names[scores.index(column.best(scores))])
    scene = shlex.quote(f"{target / 'scene'}")
    if photos is None:
        compare = f"qgs report {shlex.join(names)} --photos PHOTOS"
        if tuple(names) == MODELS:
            # the demo has other models for photos, which were trained on more than rooms
            compare = "qgs demo PHOTOS"
        return {
            compare: "compares models on a folder PHOTOS of your own, with camera poses",
            f"qgs reconstruct {best} PHOTOS --out {scene}": RECONSTRUCTED,
            f"qgs view {best}": SCENE,
            "qgs recipes": "lists recipes, each a model to train or to change",
        }
    scenes = [*dict.fromkeys(score.scene for score in results[0].evaluation.scores)]
    # qgs reconstruct and qgs view take one scene
    chosen = ["--scene", scenes[0]] if len(scenes) > 1 else []
    given = f"{best} {shlex.join([photos, *chosen, *options])}"
    return {
        f"qgs reconstruct {given} --out {scene}": RECONSTRUCTED,
        f"qgs refine {scene} {shlex.quote(photos)}": REFINED,
        f"qgs view {given}": SCENE,
    }
