"""What modules compute on the way, by name."""

from collections.abc import Callable

from torch import Tensor, nn

Change = Callable[[Tensor], Tensor]


class Recorder:
    """Outputs and inputs of modules, each changed by `shaped` before it is kept."""

    def __init__(self, shaped: Change = Tensor.detach) -> None:
        self.shaped = shaped
        self.found: dict[str, Tensor] = {}

    def output(self, name: str, module: nn.Module, shaped: Change | None = None) -> None:
        """What a module returns."""
        change = shaped or self.shaped
        module.register_forward_hook(lambda _, __, out: self.found.update({name: change(out)}))

    def input(self, name: str, module: nn.Module, channels: slice = slice(None)) -> None:
        """What a module is given."""
        module.register_forward_pre_hook(
            lambda _, given: self.found.update({name: self.shaped(given[0][:, channels])})
        )

    def outputs(self, root: nn.Module, text: str) -> None:
        """Those of modules: a name and the path of a module below `root` a line."""
        for line in text.strip().splitlines():
            name, path = line.split()
            self.output(name, root.get_submodule(path))
