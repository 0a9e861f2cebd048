"""How far a run is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from qgs.engine.folder import RunFolder
from qgs.engine.resume import refuse_other_conditions


class Counters:
    """Optimiser steps, and samples drawn over all processes.

    conditions: what must be as it was for these numbers to mean the same when the run in `folder`
    is continued, see `qgs.engine.resume.refuse_other_conditions`.
    """

    def __init__(self, conditions: Mapping[str, Any], folder: RunFolder) -> None:
        self.step = 0
        self.samples = 0
        self._conditions = conditions
        self._folder = folder

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.state.Stateful`."""
        return {"step": self.step, "samples": self.samples, **self._conditions}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.state.Stateful`. Raises OtherRunError."""
        refuse_other_conditions(state, self._conditions, self._folder)
        self.step, self.samples = state["step"], state["samples"]
