"""Operators and time of the parts of a model's forward pass."""

import re
from collections import Counter
from time import perf_counter

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Parts(TorchDispatchMode):
    """While it is active, it counts operators and seconds of each part of the model.

    A part has the name of its module without numbers of layers, such as decoder.cross_attention.
    Operators that only make views do not count. On a GPU, each part waits for its kernels.
    """

    def __init__(self, model):
        super().__init__()
        self.operators = Counter()
        self.seconds = Counter()
        self.inside = ["model"]
        self.since = 0.0
        self.hooks = []
        for name, module in model.named_modules():
            part = re.sub(r"\.\d+", "", name)
            if part and part.count(".") < 2:
                self.hooks += [
                    module.register_forward_pre_hook(lambda *_, part=part: self.spent(part)),
                    module.register_forward_hook(lambda *_: self.spent(None)),
                ]

    def __enter__(self):
        self.since = perf_counter()
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        for hook in self.hooks:
            hook.remove()

    def spent(self, entered):
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        now = perf_counter()
        self.seconds[self.inside[-1]] += now - self.since
        self.since = now
        if entered:
            self.inside.append(entered)
        else:
            self.inside.pop()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.operators[self.inside[-1]] += not func.is_view
        return func(*args, **(kwargs or {}))


def report(model, task):
    """A line for each part of the model that a task calls."""
    with Parts(model) as parts:
        task()
    return "\n".join(
        f"{part}: {parts.operators[part]} operators, {1000 * seconds:.2f} ms"
        for part, seconds in parts.seconds.most_common()
    )
