"""Continuing a run: where it stands, and whether a recipe is that of the run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from qgs.composer import Recipe, resolve
from qgs.engine.folder import RunFolder
from qgs.engine.state import SavedState, read_state

FREE = (
    "training.steps",
    "training.seconds",
    "training.save_every",
    "training.collapse_window",
    "training.workers",
    "training.render_views",
    "training.on_nonfinite",
    "training.evaluate_every",
    "training.trackers",
    "evaluation",
    "data.path",
)
"""Parts of a recipe that may change when a run is continued.

The budget may: the learning rate then follows the new one from there. The others say how long to
watch, where data lies and what is reported, not what is learnt. `training.batch_size` and
`training.accumulate` may change too, as long as a step sees as many samples over all processes.
"""

_COUNTED = ("training.batch_size", "training.accumulate")


class OtherRunError(ValueError):
    """A run cannot be continued with this recipe, these processes or this data."""


def saved_state(folder: RunFolder, recipe: Recipe) -> SavedState | None:
    """The state from which the run in `folder` continues with `recipe`; None to start it.

    A run that was killed before it first saved starts again.
    Raises FileExistsError when the folder holds something else, OtherRunError when the run has
    another recipe, CheckpointError when the state cannot be read.
    """
    folder.refuse_foreign()
    if folder.is_new:
        return None
    saved = read_state(folder.state) if folder.state.is_file() else None
    refuse_another(recipe, saved.recipe if saved else resolve(folder.recipe), folder)
    return saved


def refuse_another(recipe: Recipe, trained: Recipe, folder: RunFolder) -> None:
    """Raise OtherRunError unless `recipe` learns what `trained`, the run's recipe, does."""
    ours, theirs = dict(_leaves(recipe.tree)), dict(_leaves(trained.tree))
    keys = [*ours, *(key for key in theirs if key not in ours)]
    differing = [
        f"{key}: {ours.get(key, 'absent')} here, {theirs.get(key, 'absent')} in the run"
        for key in keys
        if ours.get(key) != theirs.get(key) and not _free(key)
    ]
    if differing:
        raise OtherRunError(
            f"the run in {folder.path} has another recipe and cannot be continued with this one:"
            + "".join(f"\n  {line}" for line in differing)
            + f"\nContinue it with its own recipe, {folder.recipe}, or choose another folder. "
            f"Only these may change: {', '.join(FREE)}."
        )


def refuse_other_conditions(
    saved: Mapping[str, Any], now: Mapping[str, Any], folder: RunFolder
) -> None:
    """Raise OtherRunError unless steps see the same data in number and order as before.

    saved, now: "step_size", samples of an optimiser step over all processes, and "scenes", the
    fingerprint of `qgs.data.order.SceneOrder`.
    """
    if saved["step_size"] != now["step_size"]:
        raise OtherRunError(
            f"an optimiser step of the run in {folder.path} sees {saved['step_size']} samples, "
            f"here it would see {now['step_size']}: choose training.batch_size, "
            "training.accumulate and the number of processes with the same product"
        )
    if saved["scenes"] != now["scenes"]:
        raise OtherRunError(
            f"the data lists other training scenes than when the run in {folder.path} was saved: "
            "bring back what was added or removed, or start a new run"
        )


def _free(key: str) -> bool:
    return key in _COUNTED or any(key == free or key.startswith(f"{free}.") for free in FREE)


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and value of everything in `tree` that is no mapping with entries."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
