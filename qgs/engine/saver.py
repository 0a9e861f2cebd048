"""When a run reaches the disk: what users load, and what continues it."""

from __future__ import annotations

from collections.abc import Mapping

from accelerate import Accelerator

from qgs.composer import resolve
from qgs.engine.collapse import GoodWeights
from qgs.engine.folder import RunFolder
from qgs.engine.processes import sharded
from qgs.engine.state import SavedState, State, Stateful, Weights, write_state
from qgs.io.checkpoint import CheckpointError, load_weights, save
from qgs.model import QueryGaussianModel


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
