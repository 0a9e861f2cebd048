"""How far a run is: steps, samples, time, and the samples that it left out."""

import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor

from qgs.contracts import TrainingConfig
from qgs.data.samples import Batch
from qgs.train.distributed import mean
from qgs.train.folder import OtherRunError

_log = logging.getLogger(__name__)


@dataclass
class Counters:
    """Steps, samples and time of a run so far, in all sessions.

    step, samples, seconds: optimiser steps, samples over all processes, and time spent; a session's
    clock starts after its first step, in which kernels compile. left_out: why samples of this
    process could not be made in this session.
    """

    accelerator: Accelerator
    config: TrainingConfig
    scenes: str
    """The `scenes_fingerprint` of the data."""
    step: int = 0
    samples: int = 0
    seconds: float = 0.0
    left_out: set[str] = field(default_factory=set)
    last_tick: float = 0.0

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_seconds = self.seconds / self.config.seconds if self.config.seconds else 0.0
        return max(self.step / self.config.steps, of_seconds)

    def every(self, steps: int) -> bool:
        """Return whether this step is one of every `steps`; none is where that is 0."""
        return bool(steps) and self.step % steps == 0

    def read(self, measured: Mapping[str, Tensor]) -> dict[str, float]:
        """Return the means of a step's numbers over processes, and read the clock.

        The host waits for the device here, so the clock shows what the step took; its mean over
        processes, so that all use up a budget of time together.
        """
        now = time.perf_counter()
        spent = torch.tensor(now - (self.last_tick or now), device=self.accelerator.device)
        self.last_tick = now
        values = torch.stack([value.float() for value in (*measured.values(), spent)])
        *numbers, seconds = mean(self.accelerator, values).tolist()
        self.seconds += seconds
        return dict(zip(measured, numbers, strict=True))

    def finish_step(self, batches: Iterable[Batch]) -> None:
        """Count a step with `batches`, and log each new reason why a sample is left out."""
        self.step += 1
        self.samples += self.config.batch_size
        for batch in batches:
            for reason in {*batch.left_out} - self.left_out:
                _log.warning("a sample is left out: %s", reason)
                self.left_out.add(reason)

    def state(self) -> dict[str, Any]:
        """Return the counts, and what must not change for them to mean the same."""
        return {
            "step": self.step,
            "samples": self.samples,
            "seconds": self.seconds,
            "step_size": self.config.batch_size,
            "scenes": self.scenes,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Count on from `state`.

        Raises OtherRunError unless steps see the same data in number and order as before.
        """
        # Sample k depends on its number alone, so equal step sizes give the same batches.
        size = state["step_size"]
        if size != self.config.batch_size:
            raise OtherRunError(
                f"the optimiser steps of this run see {size} samples, here they would see "
                f"{self.config.batch_size}: add --set training.batch_size={size}"
            )
        if state["scenes"] != self.scenes:
            raise OtherRunError(
                "the data lists other training scenes than when this run was saved: bring back "
                "what was added or removed, or start a new run"
            )
        self.step = state["step"]
        self.samples = state["samples"]
        self.seconds = state["seconds"]
