"""What `full_precision` raises, and when it leaves autocast."""

from typing import NamedTuple

import torch
from odd_views import odd_views
from tables import assert_equal
from torch import Tensor, nn

from qgs.containers import named_tensors
from qgs.precision import full_precision
from qgs.types import QueryState


class Pair(NamedTuple):
    left: Tensor
    right: Tensor


def half(*shape):
    return torch.rand(shape).bfloat16()


def state(dtype):
    return QueryState(torch.rand(1, 4, 8).to(dtype), {"place": torch.rand(1, 4, 3)})


@full_precision
def same(*args, **kwargs):
    return (*args, *kwargs.values())


def test_half_precision_is_raised_wherever_it_is_held():
    given = state(torch.bfloat16)
    bare, held, named = same(half(3), given, key=Pair(half(2), torch.ones(2)))
    assert bare.dtype == named.left.dtype == torch.float32
    assert_equal(held.features, given.features.float())
    assert held["place"] is given["place"]
    assert isinstance(named, Pair)
    (listed,), (within,) = same([half(2)], (half(2),))
    assert listed.dtype == within.dtype == torch.float32
    (nested,) = same(odd_views().to(torch.bfloat16))
    assert {part.dtype for _, part in named_tensors(nested)} == {torch.float32}
    assert given.features.dtype == torch.bfloat16, "the caller's own state is left alone"


class Layer(nn.Module):
    """A method of a module whose only argument is a container."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(8, 3)

    @full_precision
    def forward(self, state):
        assert not torch.is_autocast_enabled("cpu")
        return self.linear(state.features) + state["place"]


def test_a_method_leaves_autocast_for_a_state_and_compiles_without_a_break():
    layer = Layer()
    given = state(torch.bfloat16)
    expected = layer(given)
    compiled = torch.compile(layer, backend="eager", fullgraph=True)
    with torch.autocast("cpu", torch.bfloat16):
        found = layer(given), compiled(given)
        assert torch.is_autocast_enabled("cpu")
    assert found[0].dtype == torch.float32
    assert_equal(found, (expected, expected))
