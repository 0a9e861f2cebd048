"""State that a run saves to continue: steps, random states, moments, averaged weights."""

import math
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from accelerate import PartialState
from accelerate.utils import gather_object, reduce
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from qgs.checkpoint.model_file import load_weights, unique_tensors
from qgs.contracts import ModelComponent, Optimizer, ParameterGroup, TrainingConfig
from qgs.train.folder import OtherRunError


def make_optimizer(
    module: nn.Module, optimizer: Optimizer, factors: Mapping[str, float]
) -> torch.optim.Optimizer:
    """Build torch's optimiser, with parameters grouped by decay and factor of the learning rate.

    The innermost component around a parameter decides whether it decays (`ModelComponent.decays`);
    outside of components all but 1-d parameters do. A shared parameter goes by its first name.
    factors: as `Recipe.rate_factors`; one of 0 freezes, ValueError if all are 0.
    """
    groups: defaultdict[tuple[bool, float], list[nn.Parameter]] = defaultdict(list)
    components = {name: m for name, m in module.named_modules() if isinstance(m, ModelComponent)}
    for name, parameter in module.named_parameters():
        factor = factors[name]
        # Frozen, not only a rate of 0: no gradient, no moments, no weight decay.
        if factor == 0:
            parameter.requires_grad_(False)
        if not parameter.requires_grad:
            continue
        # Biases and gains of norms are 1-d; decay would pull them from where they work.
        decays = parameter.ndim != 1
        # Modules come before those inside them, so the innermost component has the last word.
        for outer, component in components.items():
            if not outer or name.startswith(f"{outer}."):
                inner = name.removeprefix(outer).removeprefix(".")
                decays = component.decays(inner, parameter)
        groups[not decays, factor].append(parameter)
    if not groups:
        raise ValueError("optimizer.parts freezes every parameter, so there is nothing to train")
    # Sorted: the same groups in every process and after a resume.
    return optimizer.build(
        [
            ParameterGroup(params=groups[stays, factor], decays=not stays, factor=factor)
            for stays, factor in sorted(groups)
        ]
    )


@dataclass
class Counters:
    """Steps and time of a run so far, in all sessions.

    step, seconds: optimiser steps, and time spent; a session's clock starts after its first step,
    in which kernels compile.
    """

    config: TrainingConfig
    scenes: str
    """The `scenes_fingerprint` of the data."""
    step: int = 0
    seconds: float = 0.0
    last_tick: float = 0.0

    @property
    def used(self) -> float:
        """Fraction of the budget that is used, the larger of steps and seconds."""
        of_seconds = self.seconds / (self.config.seconds or math.inf)
        return max(self.step / self.config.steps, of_seconds)

    def every(self, steps: int) -> bool:
        """Return whether this step is a multiple of `steps`; never for 0."""
        return bool(steps) and self.step % steps == 0

    def read(self, measured: Mapping[str, Tensor]) -> dict[str, float]:
        """Return the means of a step's numbers over processes, and read the clock.

        The host waits for the device here, so the clock shows what the step took; its mean over
        processes, so that all use up a budget of time together.
        """
        now = time.perf_counter()
        values = torch.stack([value.float() for value in measured.values()])
        spent = values.new_tensor([now - (self.last_tick or now)])
        self.last_tick = now
        means: Any = reduce(torch.cat([values, spent]), "mean")
        *numbers, seconds = means.tolist()
        self.seconds += seconds
        return dict(zip(measured, numbers, strict=True))

    def state(self) -> dict[str, Any]:
        """Return the counts, and the facts on which their meaning depends."""
        return {
            "step": self.step,
            "seconds": self.seconds,
            "step_size": self.config.batch_size,
            "scenes": self.scenes,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue counting from `state`.

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
        self.seconds = state["seconds"]


class RandomStates:
    """Torch's generators, of every process by its rank; components draw from no others."""

    def state(self) -> dict[str, Any]:
        """Return the states; all processes must call this."""
        own = {"torch": torch.get_rng_state()}
        if torch.cuda.is_initialized():
            own["cuda"] = torch.cuda.get_rng_state()
        found: dict[str, Any] = {}
        for rank, states in enumerate(gather_object([own])):
            found |= {f"{rank}/{key}": value for key, value in states.items()}
        return found

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore this process's generators; a rank that `state` lacks keeps its own."""
        rank = PartialState().process_index
        # A run may go on in more processes than it was saved by.
        if rank and f"{rank}/torch" not in state:
            return
        torch.set_rng_state(state[f"{rank}/torch"])
        on_device = state.get(f"{rank}/cuda")
        if torch.cuda.is_initialized() and on_device is not None:
            torch.cuda.set_rng_state(on_device)


class OptimizerState:
    """Values that torch's optimiser keeps (moments, steps), by the names of parameters.

    Torch's own `state_dict` numbers parameters by their place in the groups. `torch.distributed`'s
    helpers name them too, but give parameters without a gradient moments that they do not have.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        names = {id(parameter): name for name, parameter in module.named_parameters()}
        self._names: list[str] = []
        for group in optimizer.param_groups:
            self._names += [names[id(parameter)] for parameter in group["params"]]
        self._optimizer = optimizer

    def state(self) -> dict[str, Any]:
        """Return values by PARAMETER/KEY; under "keys" the keys of every parameter."""
        kept = self._optimizer.state_dict()["state"]
        keys: dict[str, list[str]] = {}
        found: dict[str, Any] = {"keys": keys}
        for place, name in enumerate(self._names):
            values = kept.get(place, {})
            # A parameter without a gradient has no moments: only its lack of keys shows that.
            keys[name] = list(values)
            found |= {f"{name}/{key}": value for key, value in values.items()}
        return found

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore what `state()` gave; options of the groups stay.

        Raises KeyError with what is missing.
        """
        kept: dict[int, dict[str, Any]] = {}
        for place, name in enumerate(self._names):
            if keys := state["keys"][name]:
                kept[place] = {key: state[f"{name}/{key}"] for key in keys}
        present = self._optimizer.state_dict()
        self._optimizer.load_state_dict({**present, "state": kept})


class MovingAverage(AveragedModel):
    """A copy of a model, `module`, that `update_parameters` moves towards the present weights.

    average = decay * average + (1 - decay) * weights; buffers are taken as they are.
    """

    module: Any

    def __init__(self, model: nn.Module, decay: float) -> None:
        super().__init__(model, multi_avg_fn=get_ema_multi_avg_fn(decay))
        # At 0 torch would drop the initial weights for those of the first step.
        self.n_averaged += 1

    def state(self) -> dict[str, Tensor]:
        """Return the averages, named as `qgs.checkpoint.model_file.save` takes weights."""
        return unique_tensors(self.module)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from the averages in `state`; raises CheckpointError where they do not fit."""
        load_weights(self.module, state, "the moving average")
