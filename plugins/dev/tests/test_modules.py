"""What a module keeps beside its state dict is compared."""

from collections import deque
from itertools import count

import numpy
import pytest
import torch
from qgs_dev.modules import attributes
from torch import nn


class Keeper(nn.Module):
    def __init__(self, kept: object) -> None:
        super().__init__()
        self.part = nn.Linear(2, 2)
        vars(self.part)["_kept"] = kept


KEPT = {
    "a list that grows": ([], lambda kept: kept.append(0)),
    "a queue of constant length": (deque([1, 2], maxlen=2), lambda kept: kept.append(3)),
    "a tensor": (torch.zeros(1000), lambda kept: kept[500:501].add_(1)),
    "an array": (numpy.zeros(1000), lambda kept: kept.__setitem__(500, 1)),
    "an iterator": (count(), next),
}


@pytest.mark.parametrize("what", KEPT)
def test_a_change_is_seen(what: str) -> None:
    kept, change = KEPT[what]
    module = Keeper(kept)
    before = attributes(module)
    assert attributes(module) == before
    change(kept)
    assert [name for name, value in attributes(module).items() if before.get(name) != value]


def test_what_contains_itself_comes_to_an_end() -> None:
    circle: list[object] = []
    circle.append(circle)
    assert attributes(Keeper(circle))["part._kept"] == [None]
