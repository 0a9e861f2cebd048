"""State of a run besides its weights: steps, random states, optimiser, averaged weights."""

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
from qgs.train.folder import OtherRunError, State


def make_optimizer(
    module: nn.Module, optimizer: Optimizer, factors: Mapping[str, float]
) -> torch.optim.Optimizer:
    """Build torch's optimiser, with parameters grouped by weight decay and learning-rate factor.

    `ModelComponent.decays` of the innermost component around a parameter decides whether weight
    decay applies to it. Outside of components, weight decay applies to all but 1-d parameters.
    A parameter that modules share counts once, under its first name.
    factors: learning-rate factors by parameter name, from `Recipe.rate_factors`; 0 freezes a
        parameter.
    Raises ValueError if all parameters are frozen.
    """
    groups: defaultdict[tuple[bool, float], list[nn.Parameter]] = defaultdict(list)
    decays: dict[nn.Parameter, bool] = {}
    # Modules come before those inside them, so the innermost component has the last word.
    for component in module.modules():
        if isinstance(component, ModelComponent):
            inside = component.named_parameters()
            decays |= {parameter: component.decays(name, parameter) for name, parameter in inside}
    for name, parameter in module.named_parameters():
        factor = factors[name]
        # Freezing, unlike a rate of 0, also avoids gradients, moments and weight decay.
        if factor == 0:
            parameter.requires_grad_(False)
        if not parameter.requires_grad:
            continue
        # Biases and gains of norms are 1-d; decay would make them worse.
        stays = not decays.get(parameter, parameter.ndim != 1)
        groups[stays, factor].append(parameter)
    if not groups:
        raise ValueError("optimizer.parts freezes every parameter: leave at least one to train")
    # Sorted, so that the groups are the same in every process and after a resume.
    return optimizer.build(
        [
            ParameterGroup(params=groups[stays, factor], decays=not stays, factor=factor)
            for stays, factor in sorted(groups)
        ]
    )


@dataclass
class Counters:
    """Counters of the steps and time of a run so far, over all sessions.

    step: optimiser steps. seconds: time spent. The clock of a session starts after its first step,
    because kernels compile in that step.
    """

    config: TrainingConfig
    scenes: str
    """Fingerprint of the training scenes, from `scenes_fingerprint`."""
    step: int = 0
    seconds: float = 0.0
    last_tick: float = 0.0

    @property
    def used(self) -> float:
        """Used fraction of the budget: that of the steps or of the seconds, whichever is larger."""
        return max(self.step / self.config.steps, self.seconds / (self.config.seconds or torch.inf))

    def every(self, steps: int) -> bool:
        """Return whether the present step is a multiple of `steps`; False if `steps` is 0."""
        return bool(steps) and self.step % steps == 0

    def read(self, measured: Mapping[str, Tensor]) -> dict[str, float]:
        """Return the means of the values `measured` over all processes, and advance the clock.

        The host waits for the device here, so the clock measures the whole step. The clock advances
        by the mean time of all processes, so that all use up a time budget at the same step.
        """
        now = time.perf_counter()
        values = torch.stack([value.float() for value in measured.values()])
        spent = values.new_tensor([now - (self.last_tick or now)])
        self.last_tick = now
        means: Any = reduce(torch.cat([values, spent]), "mean")
        *numbers, seconds = means.tolist()
        self.seconds += seconds
        return dict(zip(measured, numbers, strict=True))

    def state(self) -> State:
        """Return step, seconds, and the fingerprint of the scenes."""
        return {"step": self.step, "seconds": self.seconds, "scenes": self.scenes}

    def load_state(self, state: State) -> None:
        """Continue counting from `state`.

        Raises OtherRunError if the training scenes have changed.
        """
        if state["scenes"] != self.scenes:
            raise OtherRunError(
                "the training scenes have changed since this run was saved: restore the same "
                "scenes, or start a new run"
            )
        self.step = state["step"]
        self.seconds = state["seconds"]


class RandomStates:
    """States of torch's random generators in every process, by rank.

    Components draw random numbers from no other generators.
    """

    def state(self) -> State:
        """Return the states; all processes must call this."""
        own = {"torch": torch.get_rng_state()}
        if torch.cuda.is_initialized():
            own["cuda"] = torch.cuda.get_rng_state()
        return {str(rank): states for rank, states in enumerate(gather_object([own]))}

    def load_state(self, state: State) -> None:
        """Restore the generators of this process; without a saved state for its rank, keep them."""
        rank = PartialState().process_index
        # A run may continue with more processes than before.
        if rank and str(rank) not in state:
            return
        own = state[str(rank)]
        torch.set_rng_state(own["torch"])
        if torch.cuda.is_initialized() and "cuda" in own:
            torch.cuda.set_rng_state(own["cuda"])


class OptimizerState:
    """State of torch's optimiser (moments, steps), by the names of parameters.

    Torch's own `state_dict` numbers parameters by their position in the groups, which may change.
    The helpers of `torch.distributed` invent moments for parameters that never had a gradient.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        names = {parameter: name for name, parameter in module.named_parameters()}
        self._names = [
            names[parameter] for group in optimizer.param_groups for parameter in group["params"]
        ]
        self._optimizer = optimizer

    def state(self) -> State:
        """Return the optimiser's values, such as moments, of every parameter by name."""
        kept = self._optimizer.state_dict()["state"]
        # A parameter without a gradient has no moments; its empty mapping records that.
        return {name: kept.get(place, {}) for place, name in enumerate(self._names)}

    def load_state(self, state: State) -> None:
        """Restore the result of `state()`, but no learning rates or options of parameter groups.

        Raises KeyError if a parameter has no entry.
        """
        kept = {place: state[name] for place, name in enumerate(self._names) if state[name]}
        self._optimizer.load_state_dict(self._optimizer.state_dict() | {"state": kept})


class MovingAverage(AveragedModel):
    """Moving average of a model's weights; `module` is a copy of the model with the averages.

    `update_parameters` sets average = decay * average + (1 - decay) * weights. Buffers are copied
    without averaging.
    """

    module: Any

    def __init__(self, model: nn.Module, decay: float) -> None:
        super().__init__(model, multi_avg_fn=get_ema_multi_avg_fn(decay))
        # At 0, torch would replace the initial weights by those of the first step.
        self.n_averaged += 1

    def state(self) -> dict[str, Tensor]:
        """Return the averaged weights by the names that checkpoints use."""
        return unique_tensors(self.module)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore the averaged weights in `state`; raise CheckpointError if they do not fit."""
        load_weights(self.module, state, "the moving average")
