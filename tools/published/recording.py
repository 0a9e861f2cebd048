"""Recorder of what modules compute, by name."""

from collections.abc import Callable

from torch import Tensor, nn

Change = Callable[[Tensor], Tensor]


class Recorder:
    """Outputs and inputs of modules, each changed by `shaped` before it is kept."""

    def __init__(self, shaped: Change = Tensor.detach) -> None:
        self.shaped = shaped
        self.found: dict[str, Tensor] = {}

    def output(self, name: str, module: nn.Module, shaped: Change | None = None) -> None:
        """Record what a module returns."""
        change = shaped or self.shaped
        module.register_forward_hook(lambda _, __, out: self.found.update({name: change(out)}))

    def input(self, name: str, module: nn.Module, channels: slice = slice(None)) -> None:
        """Record what a module is given."""
        module.register_forward_pre_hook(
            lambda _, given: self.found.update({name: self.shaped(given[0][:, channels])})
        )

    def outputs(self, root: nn.Module, text: str) -> None:
        """Record outputs; each line of `text` is a name and a module's path below `root`."""
        for line in text.strip().splitlines():
            name, path = line.split()
            self.output(name, root.get_submodule(path))
