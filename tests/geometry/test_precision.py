"""What `full_precision` raises, and when it leaves autocast."""

from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn

from qgs.geometry.precision import full_precision
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState


class Pair(NamedTuple):
    left: Tensor
    right: Tensor


def half(*shape: int) -> Tensor:
    return torch.rand(shape).bfloat16()


def state(dtype: torch.dtype) -> QueryState:
    return QueryState(torch.rand(1, 4, 8).to(dtype), {"place": torch.rand(1, 4, 3)})


@full_precision
def same(*args: Any, **kwargs: Any) -> Any:
    return (*args, *kwargs.values())


def test_half_precision_is_raised_wherever_it_is_held() -> None:
    given = state(torch.bfloat16)
    bare, held, named = same(half(3), given, key=Pair(half(2), torch.ones(2)))
    assert bare.dtype == held.features.dtype == named.left.dtype == torch.float32
    assert torch.equal(held.features, given.features.float())
    assert held["place"] is given["place"]
    assert isinstance(named, Pair)
    (listed,), (within,) = same([half(2)])[0], same((half(2),))[0]
    assert listed.dtype == within.dtype == torch.float32
    assert given.features.dtype == torch.bfloat16, "the caller's own state is left alone"


def test_containers_within_containers_are_raised() -> None:
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "colors": (3,)}
    gaussians = Gaussians(**{name: half(1, 4, *shape) for name, shape in shapes.items()})
    (layer,) = same(LayerPrediction(gaussians, state(torch.float64)))
    assert {getattr(layer.gaussians, name).dtype for name in shapes} == {torch.float32}
    assert layer.state.features.dtype == torch.float64


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_what_needs_no_raising_is_handed_on_itself(dtype: torch.dtype) -> None:
    cameras = Cameras(torch.eye(4, dtype=dtype)[None], torch.ones(1, 4, dtype=dtype), (8, 8))
    given = (state(dtype), cameras, {"a": torch.ones(1, dtype=dtype)}, [3], (8, 8), "text", None)
    assert all(found is one for found, one in zip(same(*given), given, strict=True))


class Layer(nn.Module):
    """A method of a module whose only argument is a container."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(8, 3)

    @full_precision
    def forward(self, state: QueryState) -> Tensor:
        assert not torch.is_autocast_enabled("cpu")
        return self.linear(state.features) + state["place"]


def test_a_method_leaves_autocast_for_a_state() -> None:
    layer, given = Layer(), state(torch.bfloat16)
    expected = layer(given)
    with torch.autocast("cpu", torch.bfloat16):
        found = layer(given)
        assert torch.is_autocast_enabled("cpu")
    assert found.dtype == torch.float32
    assert torch.equal(found, expected)


def test_it_compiles_without_a_break() -> None:
    layer, given = Layer(), state(torch.bfloat16)
    compiled = torch.compile(layer, backend="eager", fullgraph=True)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(compiled(given), layer(given))


@pytest.mark.parametrize(
    ("args", "left"),
    [
        ((QueryState(torch.ones(1, 2, 3, device="meta")),), "meta"),
        (({"a": [torch.ones(1)]},), "cpu"),
        ((torch.ones(1), QueryState(torch.ones(1, 2, 3, device="meta"))), "cpu"),
        ((QueryState(torch.ones(1, 2, 3, device="meta")), torch.ones(1)), "cpu"),
        ((), "cuda"),
        ((nn.Linear(2, 2), 3), "cuda"),
    ],
)
def test_autocast_is_left_for_the_device_of_the_tensors(
    args: tuple[Any, ...], left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered: list[Mapping[str, Any]] = []

    def autocast(**options: Any) -> Any:
        entered.append(options)
        return nullcontext()

    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device: True)
    monkeypatch.setattr(torch, "autocast", autocast)
    same(*args)
    expected = [] if left == "meta" else [{"device_type": left, "enabled": False}]
    assert entered == expected


def test_the_device_of_a_state_on_cuda_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    on_cuda = type("OnCuda", (Tensor,), {"device": torch.device("cuda", 0)})
    asked: list[str] = []
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device: bool(asked.append(device)))
    same(QueryState(torch.ones(1, 2, 3).as_subclass(on_cuda)))
    assert asked == ["cuda"]
