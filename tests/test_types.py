"""Containers refuse what does not fit together, where it is made."""

from dataclasses import replace

import pytest
import torch

from qgs.types import (
    Cameras,
    GaussianAttributes,
    ImageMemory,
    QueryState,
    Rendering,
    SpatialSupport,
    Views,
    map_tensors,
    named_tensors,
)

THREE, FOUR, ONE = torch.zeros(1, 2, 5, 3), torch.zeros(1, 2, 5, 4), torch.zeros(1, 2, 5)
CAMERA = Cameras(torch.eye(4)[None, None], torch.ones(1, 1, 4), (8, 8))
RGB, ALPHA = torch.zeros(1, 2, 3, 4, 5), torch.zeros(1, 2, 1, 4, 5)


@pytest.fixture
def memory() -> ImageMemory:
    return ImageMemory(
        keys=torch.zeros(2, 4, 6, 8),
        values=torch.zeros(2, 4, 6, 8),
        features=torch.zeros(2, 6, 32),
        patch_rays=torch.ones(2, 6, 6, requires_grad=True),
        grid=(1, 2, 3),
    )


def zeros(*shape: int) -> torch.Tensor:
    return torch.zeros(shape)


@pytest.mark.parametrize(
    ("make", "parts", "message"),
    [
        (QueryState, [zeros(3, 4)], r"features must have shape \(B, N, D\)"),
        (QueryState, [zeros(2, 3, 4), {"place": zeros(2, 4, 3)}], "the field place must have sh"),
        (Cameras, [zeros(2, 3, 4, 4), zeros(3, 4), (8, 8)], r"intrinsics .*\(2, 3, 4\), got"),
        (Cameras, [torch.eye(3), zeros(4), (8, 8)], r"Cameras\.c2w .*\(\.\.\., 4, 4\), got"),
        (Views, [zeros(1, 1, 3, 8, 8).byte(), CAMERA], "divide 8-bit images by 255"),
        (GaussianAttributes, [THREE, THREE, THREE, ONE, THREE], r"GaussianAttributes\.quats"),
        (GaussianAttributes, [THREE, THREE, FOUR, ONE[..., None], THREE], r"utes\.opacities"),
        (Rendering, [RGB, ALPHA, ALPHA[..., :4]], r"Rendering\.depth"),
        (Rendering, [RGB[0], ALPHA[0], ALPHA[0]], r"\.rgb .*add a leading dimension for a single"),
        (SpatialSupport, [zeros(1, 2, 3), zeros(1, 2, 3)], r"SpatialSupport\.axes"),
    ],
)
def test_what_does_not_fit_together_is_refused(make: type, parts: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(*parts)


@pytest.mark.parametrize(
    "wrong",
    [
        {"features": torch.zeros(6, 32)},
        {"features": torch.zeros(2, 7, 32)},
        {"values": torch.zeros(2, 4, 5, 8)},
        {"patch_rays": torch.zeros(2, 6, 3)},
        {"grid": (1, 2, 2)},
    ],
)
def test_parts_of_a_memory_must_fit(memory: ImageMemory, wrong: dict) -> None:
    with pytest.raises(ValueError, match=r"ImageMemory\."):
        replace(memory, **wrong)


def test_memo_does_not_leak_between_gradient_modes(memory: ImageMemory) -> None:
    def doubled() -> torch.Tensor:
        return memory.once("test.doubled", lambda: 2 * memory.patch_rays)

    with torch.no_grad():
        assert not doubled().requires_grad
    with torch.inference_mode():
        assert doubled().is_inference()
    assert doubled().requires_grad
    assert doubled() is doubled()


def test_a_state_knows_its_fields_by_name() -> None:
    state = QueryState(torch.zeros(2, 3, 4), {"place": torch.zeros(2, 3, 1)})
    assert "place" in state
    assert "elsewhere" not in state


def test_every_nested_tensor_is_mapped_and_named() -> None:
    state = QueryState(torch.zeros(1, 2, 4), {"place": torch.ones(1, 2, 3)})
    value = {"state": state, 3: [torch.ones(2), "text", (torch.zeros(1), None)]}
    assert [name for name, _ in named_tensors(value, "value")] == [
        "value.state.features",
        "value.state.fields.place",
        "value.3.0",
        "value.3.2.0",
    ]
    doubled = map_tensors(lambda x: 2 * x if x.any() else x, value)
    assert torch.equal(doubled["state"]["place"], torch.full((1, 2, 3), 2.0))
    assert doubled["state"].features is state.features
    assert doubled[3][1:] == ["text", value[3][2]]
    assert doubled[3][2] is value[3][2]  # no tensor in it changed
    assert map_tensors(lambda x: x, value) is value


def test_named_tuples_stay_named_tuples() -> None:
    found = torch.tensor([3.0, 1.0]).sort()
    assert map_tensors(lambda x: x + 1, found).indices.tolist() == [2, 1]
