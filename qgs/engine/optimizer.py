"""AdamW with weight decay where the components want it (LocusGS release)."""

from __future__ import annotations

from torch import nn
from torch.distributed.tensor import DTensor
from torch.optim import AdamW

from qgs.contracts import ModelComponent, TrainingConfig


def make_optimizer(module: nn.Module, config: TrainingConfig) -> AdamW:
    """AdamW over all parameters of `module` that train, in decayed and undecayed groups.

    Parameters that lie in shards and whole ones are in groups of their own, where both exist.
    """
    decayed, undecayed = parameter_groups(module)
    groups = [
        {"params": parameters, "weight_decay": decay}
        for group, decay in ((decayed, config.weight_decay), (undecayed, 0.0))
        for parameters in _by_kind(group)
    ]
    return AdamW(groups, lr=config.learning_rate, betas=config.betas, fused=True)


def _by_kind(parameters: list[nn.Parameter]) -> list[list[nn.Parameter]]:
    """Parameters in shards and whole ones apart: no kernel updates both at once."""
    kinds: dict[bool, list[nn.Parameter]] = {}
    for parameter in parameters:
        kinds.setdefault(isinstance(parameter, DTensor), []).append(parameter)
    return list(kinds.values())


def parameter_groups(module: nn.Module) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Parameters with and without weight decay.

    The innermost component around a parameter decides (`ModelComponent.decays`); outside of
    components all but 1-d parameters decay. A shared parameter goes by its first name.
    """
    decayed: list[nn.Parameter] = []
    undecayed: list[nn.Parameter] = []
    components = {name: m for name, m in module.named_modules() if isinstance(m, ModelComponent)}
    for name, parameter in module.named_parameters():
        if parameter.requires_grad:
            decays = _decays(name, parameter, components)
            (decayed if decays else undecayed).append(parameter)
    return decayed, undecayed


def _decays(name: str, parameter: nn.Parameter, components: dict[str, ModelComponent]) -> bool:
    owners = [prefix for prefix in components if name.startswith(f"{prefix}.") or not prefix]
    if not owners:
        return parameter.ndim != 1
    innermost = max(owners, key=len)
    inner_name = name.removeprefix(innermost).removeprefix(".")
    return components[innermost].decays(inner_name, parameter)
