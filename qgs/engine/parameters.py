"""Parameter groups, learning-rate factors of parts of the model, averaged weights."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fnmatch import fnmatchcase
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from qgs.composer.errors import nearest
from qgs.contracts import ModelComponent, Optimizer, OptimizerConfig, ParameterGroup
from qgs.engine.distributed import placed_like, whole
from qgs.io.checkpoint import unique_tensors


def make_optimizer(module: nn.Module, optimizer: Optimizer) -> torch.optim.Optimizer:
    """Torch's optimiser of `module`, a model or an objective; what its `parts` freeze is frozen.

    Raises ValueError for patterns of `parts` that match nothing, or freeze everything.
    """
    config = optimizer.config
    factors = rate_factors(module, config.parts if isinstance(config, OptimizerConfig) else {})
    for name, parameter in module.named_parameters():
        if factors[name] == 0:
            parameter.requires_grad_(False)
    groups = parameter_groups(module, factors)
    if not groups:
        raise ValueError("optimizer.parts freezes every parameter, so there is nothing to train")
    return optimizer.build(groups)


def rate_factors(module: nn.Module, parts: Mapping[str, float]) -> dict[str, float]:
    """Factor of the learning rate for every parameter of `module`, by name; 1 where none is given.

    parts: see `OptimizerConfig`; a shared parameter goes by its first name. Raises ValueError.
    """
    factors = {name: 1.0 for name, _ in module.named_parameters()}
    for pattern, factor in parts.items():
        wanted = pattern.removeprefix("model.").split(".")
        matched = False
        for name in factors:
            steps = name.removeprefix("model.").split(".")
            if len(wanted) <= len(steps) and all(map(fnmatchcase, steps, wanted)):
                factors[name], matched = factor, True
        if not matched:
            paths = [name.removeprefix("model.").split(".") for name in factors]
            starred = [["*" if step.isdigit() else step for step in path] for path in paths]
            known = {".".join(path[: len(wanted)]) for path in paths + starred}
            near = nearest(".".join(wanted), known)
            outermost = ", ".join(dict.fromkeys(path[0] for path in paths))
            raise ValueError(
                f"optimizer.parts: the pattern `{pattern}` matches no parameter of the model; "
                + (f"did you mean `{near}`?" if near else f"its parts: {outermost}")
            )
    return factors


def parameter_groups(module: nn.Module, factors: Mapping[str, float]) -> list[ParameterGroup]:
    """The parameters of `module` that train, together with others that are treated alike.

    The innermost component around a parameter decides whether it decays (`ModelComponent.decays`);
    outside of components all but 1-d parameters do. A shared parameter goes by its first name.
    Parameters in shards and whole ones are kept apart: no kernel updates both at once.
    """
    groups: dict[Any, ParameterGroup] = {}
    components = {name: m for name, m in module.named_modules() if isinstance(m, ModelComponent)}
    for name, parameter in module.named_parameters():
        if not parameter.requires_grad:
            continue
        owners = [prefix for prefix in components if name.startswith(f"{prefix}.") or not prefix]
        factor, decays = factors[name], parameter.ndim != 1
        if owners:
            innermost = max(owners, key=len)
            inner_name = name.removeprefix(innermost).removeprefix(".")
            decays = components[innermost].decays(inner_name, parameter)
        key = (not decays, isinstance(parameter, DTensor), factor)
        empty = ParameterGroup(params=[], decays=decays, factor=factor)
        groups.setdefault(key, empty)["params"].append(parameter)
    return [groups[key] for key in sorted(groups)]


class MovingAverage:
    """float32 copies of the weights of `model`, which `update` moves towards the present ones.

    average = decay * average + (1 - decay) * weights; buffers are taken as they are.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self._model, self._decay = model, decay
        self._averages: dict[str, Tensor] = {}
        for name, tensor in unique_tensors(model).items():
            copy = tensor.detach().clone()
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
        """The model with the averaged weights, for the `with` block only."""
        tensors = unique_tensors(self._model)
        present = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        try:
            _copy(self._averages, tensors)
            yield
        finally:
            _copy(present, tensors)

    def state(self) -> dict[str, Tensor]:
        """The averages, named as `qgs.io.checkpoint.save` takes weights."""
        return {name: whole(tensor) for name, tensor in self._averages.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from the averages in `state`."""
        own = self._averages
        _copy({name: placed_like(state[name], tensor) for name, tensor in own.items()}, own)


@torch.no_grad()
def _copy(tensors: Mapping[str, Tensor], into: Mapping[str, Tensor]) -> None:
    for name, tensor in into.items():
        tensor.copy_(tensors[name])
