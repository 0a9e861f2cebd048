"""One seed for every source of randomness."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import gather_object


def set_seed(seed: int) -> None:
    """Seed python, numpy and torch on all devices."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


class RandomStates:
    """The generators of python, numpy and torch, of every process by its rank."""

    def __init__(self, accelerator: Accelerator) -> None:
        self._accelerator = accelerator

    def state(self) -> dict[str, Any]:
        """See `qgs.engine.state.Stateful`."""
        own = [_generators(self._accelerator.device)]
        ranks = gather_object(own) if self._accelerator.num_processes > 1 else own
        return {f"{rank}/{key}": v for rank, state in enumerate(ranks) for key, v in state.items()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """See `qgs.engine.state.Stateful`; a rank that `state` does not know keeps its own."""
        prefix = f"{self._accelerator.process_index}/"
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        if own:
            _restore_generators(own, self._accelerator.device)


def _generators(device: torch.device) -> dict[str, Any]:
    version, words, gauss = random.getstate()
    numpy_state = np.random.get_state(legacy=False)
    assert isinstance(numpy_state, dict)
    twister = numpy_state["state"]
    state: dict[str, Any] = {
        "python": [version, list(words), gauss],
        "numpy": {**numpy_state, "state": {**twister, "key": twister["key"].tolist()}},
        "torch": torch.get_rng_state(),
    }
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def _restore_generators(state: Mapping[str, Any], device: torch.device) -> None:
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    twister = {**state["numpy"]["state"]}
    twister["key"] = np.array(twister["key"], np.uint32)
    np.random.set_state({**state["numpy"], "state": twister})
    torch.set_rng_state(state["torch"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)
