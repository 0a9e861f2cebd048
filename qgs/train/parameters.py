"""Parameter groups, the optimiser's state, and averaged weights."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from qgs.checkpoint.model_file import unique_tensors
from qgs.contracts import ModelComponent, Optimizer, ParameterGroup


def make_optimizer(
    module: nn.Module, optimizer: Optimizer, factors: Mapping[str, float]
) -> torch.optim.Optimizer:
    """Build torch's optimiser; a `Recipe.rate_factors` of 0 freezes, ValueError if all are 0."""
    for name, parameter in module.named_parameters():
        # Frozen, not only a rate of 0: no gradient, no moments, no weight decay.
        if factors[name] == 0:
            parameter.requires_grad_(False)
    groups = parameter_groups(module, factors)
    if not groups:
        raise ValueError("optimizer.parts freezes every parameter, so there is nothing to train")
    return optimizer.build(groups)


def parameter_groups(module: nn.Module, factors: Mapping[str, float]) -> list[ParameterGroup]:
    """Group the parameters of `module` that train by decay and factor of the learning rate.

    The innermost component around a parameter decides whether it decays (`ModelComponent.decays`);
    outside of components all but 1-d parameters do. A shared parameter goes by its first name.
    """
    groups: dict[Any, ParameterGroup] = {}
    components = {name: m for name, m in module.named_modules() if isinstance(m, ModelComponent)}
    for name, parameter in module.named_parameters():
        if not parameter.requires_grad:
            continue
        # Biases and gains of norms are 1-d; decay would pull them from where they work.
        decays = parameter.ndim != 1
        # Modules come before those inside them, so the innermost component has the last word.
        for outer, component in components.items():
            if not outer or name.startswith(f"{outer}."):
                inner = name.removeprefix(outer).removeprefix(".")
                decays = component.decays(inner, parameter)
        factor = factors[name]
        empty = ParameterGroup(params=[], decays=decays, factor=factor)
        groups.setdefault((not decays, factor), empty)["params"].append(parameter)
    # Sorted: the same groups in every process and after a resume.
    return [groups[key] for key in sorted(groups)]


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


class MovingAverage:
    """float32 copies of the weights of `model`, which `update` moves towards the present ones.

    average = decay * average + (1 - decay) * weights; buffers are taken as they are.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self._model = model
        self._decay = decay
        self._averages: dict[str, Tensor] = {}
        for name, tensor in unique_tensors(model).items():
            copy = tensor.detach().clone()
            # float32, since a decay near 1 moves the average by less than bf16 resolves.
            self._averages[name] = copy.float() if isinstance(tensor, nn.Parameter) else copy

    @torch.no_grad()
    def update(self) -> None:
        """Take the present weights into the average."""
        for name, tensor in unique_tensors(self._model).items():
            if isinstance(tensor, nn.Parameter):
                self._averages[name].lerp_(tensor.detach().float(), 1 - self._decay)
            else:
                self._averages[name].copy_(tensor)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Give the model the averaged weights, for the `with` block only."""
        tensors = unique_tensors(self._model)
        present = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        try:
            _copy(self._averages, tensors)
            yield
        finally:
            _copy(present, tensors)

    def state(self) -> dict[str, Tensor]:
        """Return the averages, named as `qgs.checkpoint.model_file.save` takes weights."""
        return dict(self._averages)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from the averages in `state`."""
        _copy(state, self._averages)


@torch.no_grad()
def _copy(tensors: Mapping[str, Tensor], into: Mapping[str, Tensor]) -> None:
    for name, tensor in into.items():
        tensor.copy_(tensors[name])
