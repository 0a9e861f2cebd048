"""Operators and time of the parts of a model's forward pass."""

import re
from collections import Counter
from time import perf_counter

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Parts(TorchDispatchMode):
    """While it is active, it counts operators and seconds of each part of the model, which keeps
    the hooks.

    A part has the name of its module without numbers of layers, such as decoder.cross_attention.
    Operators that only make views do not count. On a GPU, each part waits for its kernels.
    """

    def __init__(self, model):
        super().__init__()
        self.operators = Counter()
        self.seconds = Counter()
        self.inside = ["model"]
        self.since = perf_counter()
        for name, module in model.named_modules():
            part = re.sub(r"\.\d+", "", name)
            if part and part.count(".") < 2:
                module.register_forward_pre_hook(lambda *_, part=part: self.spent(part))
                module.register_forward_hook(lambda *_: self.spent(None))

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


def parts_of(model, task):
    """Operators and seconds of each part of the model that a task calls."""
    with Parts(model) as parts:
        task()
    return parts.operators, parts.seconds
