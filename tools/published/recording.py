"""Recorder of inputs and outputs of modules inside a model."""

from collections.abc import Callable

from torch import Tensor, nn

Change = Callable[[Tensor], Tensor]


class Recorder:
    """Recorder of inputs and outputs of modules, by name.

    shaped: function that changes each tensor before it is kept.
    """

    def __init__(self, shaped: Change = Tensor.detach) -> None:
        self.shaped = shaped
        self.found: dict[str, Tensor] = {}

    def output(self, name: str, module: nn.Module, shaped: Change | None = None) -> None:
        """Record the outputs of a module as `name`."""
        change = shaped or self.shaped
        module.register_forward_hook(lambda _, __, out: self.found.update({name: change(out)}))

    def input(self, name: str, module: nn.Module, channels: slice = slice(None)) -> None:
        """Record some channels of the inputs of a module as `name`."""
        module.register_forward_pre_hook(
            lambda _, given: self.found.update({name: self.shaped(given[0][:, channels])})
        )

    def outputs(self, root: nn.Module, text: str) -> None:
        """Record outputs. Each line of `text` is a name and the path of a module in `root`."""
        for line in text.strip().splitlines():
            name, path = line.split()
            self.output(name, root.get_submodule(path))
