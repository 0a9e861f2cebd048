"""Parameter groups, the optimiser's state, and averaged weights."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from qgs.checkpoint.model_file import load_weights, unique_tensors
from qgs.contracts import ModelComponent, Optimizer, ParameterGroup


def make_optimizer(
    module: nn.Module, optimizer: Optimizer, factors: Mapping[str, float]
) -> torch.optim.Optimizer:
    """Build torch's optimiser, with parameters grouped by decay and factor of the learning rate.

    The innermost component around a parameter decides whether it decays (`ModelComponent.decays`);
    outside of components all but 1-d parameters do. A shared parameter goes by its first name.
    factors: as `Recipe.rate_factors`; one of 0 freezes, ValueError if all are 0.
    """
    groups: dict[tuple[bool, float], ParameterGroup] = {}
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
        empty = ParameterGroup(params=[], decays=decays, factor=factor)
        groups.setdefault((not decays, factor), empty)["params"].append(parameter)
    if not groups:
        raise ValueError("optimizer.parts freezes every parameter, so there is nothing to train")
    # Sorted: the same groups in every process and after a resume.
    return optimizer.build([groups[key] for key in sorted(groups)])


class OptimizerState:
    """Values that torch's optimiser keeps (moments, steps), by the names of parameters.

    Torch's own `state_dict` numbers parameters by their place in the groups. `torch.distributed`'s
    helpers name them too, but give parameters without a gradient moments that they do not have.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        names = {id(parameter): name for name, parameter in module.named_parameters()}
        self._names = [names[id(p)] for group in optimizer.param_groups for p in group["params"]]
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

        Raises KeyError with what is missing, ValueError for what is not of these parameters.
        """
        kept: dict[int, dict[str, Any]] = {}
        for place, name in enumerate(self._names):
            if keys := state["keys"][name]:
                kept[place] = {key: state[f"{name}/{key}"] for key in keys}
        if len(state) > 1 + sum(map(len, kept.values())):
            raise ValueError("it has values of unknown parameters")
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
        """Go on from the averages in `state`; raises CheckpointError where they do not fit."""
        load_weights(self.module, state, "the moving average")
