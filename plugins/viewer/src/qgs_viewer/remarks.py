"""Sentences on results: scales that were found, photos that were chosen, next commands."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from qgs.wording import counted, listed
from qgs_viewer.comparison import Model


def scale_remarks(models: Sequence[Model]) -> Iterator[str]:
    """Yield a sentence with the scales of camera positions found for each model, if any."""
    parts = []
    for model in models:
        if found := model.scales.values():
            factors = [scale.factor for scale in found]
            ends = dict.fromkeys(f"{factor:.3g}" for factor in (min(factors), max(factors)))
            mean = sum(scale.psnr for scale in found) / len(found)
            poor = sum(bool(scale.poor) for scale in found)
            fault = f", no good scale for {counted(poor, 'window')}" if poor else ""
            parts.append(f"{model.name} {' to '.join(ends)} ({mean:.1f} dB{fault})")
    if parts:
        found_scales = "; ".join(parts)
        yield f"Scales found by rendering photos: {found_scales}. --scale sets another scale."


def remarks(models: Sequence[Model]) -> list[str]:
    """Return remarks on the chosen photos, on the evaluation of each model, and on scales.

    A remark that holds for several models is given once, with their names.
    """
    names: dict[str, list[str]] = {}
    for model in models:
        evaluation = model.evaluation
        missing = [f"{scene} is not evaluated: {why}" for scene, why in evaluation.missing.items()]
        for remark in (*evaluation.remarks, *missing):
            # the same remark on three models stands once, with their names
            names.setdefault(remark, []).append(model.name)
    texts = [f"{', '.join(named)}: {remark}." for remark, named in names.items()]
    return [*chosen_windows(models[0]), *texts, *scale_remarks(models)]


def chosen_windows(model: Model) -> Iterator[str]:
    """Yield a line for each scene of a user's photos, with inputs and scored photos of each window.

    A window consists of chosen input photos, and of scored photos near these inputs.
    """
    if model.windows is None:
        return
    for score in model.evaluation.scores:
        texts = []
        for window in score.views:
            given, judged = (listed(score.names.get(f, f) for f in frames) for frames in window)
            texts.append(f"{given} ({judged})")
        windows = "; ".join(texts)
        yield f"{score.scene}, input photos (scored photos in parentheses): {windows}"


def next_commands(
    names: Sequence[str],
    models: Sequence[Model],
    target: Path,
    photos: str | None = None,
    options: Sequence[str] = (),
) -> dict[str, str]:
    """Return shell commands that a reader may run next, each with a phrase that says what it does.

    names: the models as given on the command line. target: folder of the report, into which the
    commands write. photos: folder or video of the user; None for unseen scenes. options: options
    of the report that concern `photos`, such as --size.
    """
    first, column = next(iter(models[0].evaluation.columns.items()))
    scores = [model.evaluation.mean(f"model_{first}") for model in models]
    # of equal ones the first
    best = names[scores.index(column.best(scores))]
    scenes = [*dict.fromkeys(score.scene for score in models[0].evaluation.scores)]
    # qgs reconstruct and qgs view take one scene
    chosen = ["--scene", scenes[0]] if photos and len(scenes) > 1 else []
    place = photos or "PHOTOS"
    given = shlex.join([best, place, *chosen, *options])
    scene = shlex.quote(f"{target / 'scene'}")
    return {
        f"qgs reconstruct {given} --out {scene}": "reconstructs the scene and writes a PLY file",
        f"qgs refine {scene} {shlex.quote(place)}": "fits the scene's Gaussians to all photos",
        f"qgs view {given}": "shows the scene in the browser: turn it, pick queries",
    }
