"""When a run reaches the disk, and how it ends."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import NoReturn

from accelerate import Accelerator

from qgs.composer import resolve
from qgs.data.sampling import Batch
from qgs.engine.checkpoint import Counters, SavedState, State, Stateful, Weights, write_state
from qgs.engine.distributed import sharded
from qgs.engine.folder import RunFolder
from qgs.engine.guard import (
    BROKEN_REMEDIES,
    COLLAPSE_REMEDIES,
    CollapseDetector,
    CollapseError,
    GoodWeights,
    NonFiniteError,
    broken_tensors,
)
from qgs.engine.nonfinite import PATIENCE, Incident, Incidents
from qgs.io.checkpoint import CheckpointError, load_weights, save
from qgs.model import QueryGaussianModel


def _listed(causes: Sequence[str]) -> str:
    return "".join(f"\n  - {cause}" for cause in causes)


_log = logging.getLogger(__name__)


class Endings:
    """Saves a run on its way and at its end. All processes must call each of these together."""

    def __init__(
        self,
        saver: Saver,
        counters: Counters,
        detector: CollapseDetector,
        incidents: Incidents,
        skips: bool,
    ) -> None:
        """skips: whether steps that are not finite are left out instead of ending the run."""
        self._saver = saver
        self._counters = counters
        self._detector = detector
        self._incidents = incidents
        self._skips = skips

    def save(self) -> None:
        """Save the run where it stands. Raises CollapseError for weights that are not finite."""
        self.refuse_broken_weights()
        self._saver.save(self._counters.step)

    def keep(self) -> None:
        """Save the run as one that may go on; a dead model's checkpoint is the last good one."""
        if self._detector.dead_after(self._counters.step):
            self._saver.save_good()
            self._saver.save_state()
        else:
            self.save()

    def finish(self, stopped_by: str | None) -> None:
        """Save a run whose budget is used or that was stopped. Raises CollapseError."""
        dead = self._detector.dead_steps
        symptom = f"for the last {dead} steps {self._detector.symptom}"
        if not self._detector.dead_after(self._counters.step):
            if dead:
                _log.warning(
                    "training ended in doubt: %s; the weights are saved as they are", symptom
                )
        elif not stopped_by:
            self._collapse(symptom, COLLAPSE_REMEDIES)
        self.keep()

    def refuse_collapse(self) -> None:
        """Raise CollapseError when the detector's window is full of dead steps."""
        if self._detector.collapsed:
            symptom = f"for {self._detector.dead_steps} steps {self._detector.symptom}"
            self._collapse(symptom, COLLAPSE_REMEDIES)

    def refuse_broken_weights(self) -> None:
        """Raise CollapseError when weights are not finite."""
        problem = broken_tensors(self._saver.model)
        if problem:
            self._collapse(problem, BROKEN_REMEDIES)

    def leave_out(self, batches: Sequence[Batch], symptom: str) -> None:
        """Look into the present step, which is not finite; return to go on without it.

        Raises NonFiniteError, the run then being saved as it was before that step, and
        CollapseError when the model is already lost.
        """
        step = self._counters.step + 1
        found = self._incidents.look_into(step, batches, symptom)
        if self._skips and self._incidents.in_a_row <= PATIENCE:
            _log.warning("step %d is skipped: %s", step, found)
            return
        if self._detector.dead_steps or broken_tensors(self._saver.model):
            self._collapse(str(found), BROKEN_REMEDIES, step)
        self._saver.save(self._counters.step)
        raise NonFiniteError(_told(found, step, self._incidents.in_a_row > PATIENCE))

    def _collapse(self, problem: str, causes: Sequence[str], step: int | None = None) -> NoReturn:
        self._saver.save_good()
        raise CollapseError(
            f"training collapsed at step {step or self._counters.step}: {problem}. The weights of "
            f"step {self._saver.good.step} are kept in {self._saver.folder.checkpoint}. "
            f"Likely causes:{_listed(causes)}"
        )


def _told(found: Incident, step: int, for_long: bool) -> str:
    """What happened in `step`, what to do, and why it may be. for_long: after many such steps."""
    if for_long:
        first = (
            f"step {step} is not finite, after {PATIENCE} steps in a row were skipped. The run is "
            "saved as it was before this step; continue it with --resume when the cause is gone"
        )
    else:
        first = (
            f"step {step} is not finite. To go on without it, repeat the command with `--resume "
            "--set training.on_nonfinite=skip`; the run is saved as it was before this step"
        )
    if found.in_data:
        return f"{first}.\nThe data is to blame, see `qgs data check`: {found}"
    return f"{first}.\n{found}.\nLikely causes:{_listed(BROKEN_REMEDIES)}"


class Saver:
    """Writes the checkpoint and the state of a run; of several processes, the main one writes.

    parts: everything that continues the run, by name; "weights", "good", the copies that outlive a
        collapse, and "ema", if there is one, are also what checkpoints are written from.
    Each file appears whole or not at all, and the state is complete by itself. It comes last: what
    is in it has reached the other files.
    """

    def __init__(
        self,
        accelerator: Accelerator,
        folder: RunFolder,
        model: QueryGaussianModel,
        good: GoodWeights,
        parts: Mapping[str, Stateful],
    ) -> None:
        self._accelerator = accelerator
        self.folder = folder
        self.model = model
        self.good = good
        self._weights = Weights(model)
        self._parts = {"weights": self._weights, "good": good, **parts}

    def save(self, step: int) -> None:
        """Save the run after `step` optimiser steps. All processes must call this."""
        parts = self._states()
        if self._accelerator.is_main_process:
            if not self.folder.state.exists():
                self._write(parts)  # a checkpoint alone is a run that cannot be continued
            extra = {"step": str(step)}
            save(self.model, self.folder.checkpoint, extra=extra, weights=parts["weights"])
            if "ema" in parts:
                averages = parts["ema"]
                save(self.model, self.folder.checkpoint_ema, extra=extra, weights=averages)
            self._write(parts)
        self._accelerator.wait_for_everyone()

    def save_state(self) -> None:
        """Save what continues the run, and leave the checkpoint. All processes must call this."""
        parts = self._states()
        if self._accelerator.is_main_process:
            self._write(parts)
        self._accelerator.wait_for_everyone()

    def _states(self) -> dict[str, State]:
        return {name: part.state() for name, part in self._parts.items()}

    def _write(self, parts: Mapping[str, State]) -> None:
        self.folder.synchronise()
        assert self.model.recipe is not None
        write_state(self.folder.state, self.model.recipe, parts)

    def save_good(self) -> None:
        """Save a checkpoint of the last good weights. All processes must call this."""
        if self._accelerator.is_main_process:
            extra = {"step": str(self.good.step)}
            save(self.model, self.folder.checkpoint, extra=extra, weights=self.good.tensors)
        self._accelerator.wait_for_everyone()

    def whole_model(self) -> QueryGaussianModel:
        """The model, as a copy of its own where its weights lie in shards. All must call this."""
        if not sharded(self.model):
            return self.model
        assert self.model.recipe is not None
        copy = resolve(self.model.recipe).build_model()
        load_weights(copy, self._weights.state(), "the model in shards")
        return copy.to(self._accelerator.device)

    def restore(self, saved: SavedState) -> None:
        """Bring every part back to where `saved` was taken. All processes must call this.

        Raises CheckpointError, and what parts raise.
        """
        missing = [name for name in self._parts if name not in saved.parts]
        if missing:
            raise CheckpointError(
                f"{self.folder.state} lacks {', '.join(missing)}: another version of qgs wrote "
                "it; continue the run with that version"
            )
        for name, part in self._parts.items():
            part.load_state(saved.parts[name])
