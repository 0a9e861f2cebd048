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


@pytest.fixture
def memory() -> ImageMemory:
    return ImageMemory(
        keys=torch.zeros(2, 4, 6, 8),
        values=torch.zeros(2, 4, 6, 8),
        features=torch.zeros(2, 6, 32),
        patch_rays=torch.ones(2, 6, 6, requires_grad=True),
        grid=(1, 2, 3),
    )


def test_8_bit_images_are_refused_with_the_remedy() -> None:
    cameras = Cameras(torch.eye(4)[None, None], torch.ones(1, 1, 4), (8, 8))
    with pytest.raises(ValueError, match=r"divide 8-bit images by 255"):
        Views(torch.zeros(1, 1, 3, 8, 8, dtype=torch.uint8), cameras)


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


def test_state_fields_share_scenes_and_queries() -> None:
    with pytest.raises(ValueError, match=r"features must have shape \(B, N, D\)"):
        QueryState(torch.zeros(3, 4))
    with pytest.raises(ValueError, match=r"the field place must have shape"):
        QueryState(torch.zeros(2, 3, 4), {"place": torch.zeros(2, 4, 3)})


def test_cameras_share_their_leading_axes() -> None:
    with pytest.raises(ValueError, match=r"Cameras\.intrinsics must have shape \(2, 3, 4\), got"):
        Cameras(torch.eye(4).expand(2, 3, 4, 4), torch.ones(3, 4), (8, 8))
    with pytest.raises(ValueError, match=r"Cameras\.c2w must have shape \(\.\.\., 4, 4\), got"):
        Cameras(torch.eye(3), torch.ones(4), (8, 8))


def test_attributes_share_scenes_queries_and_gaussians() -> None:
    three, four, one = torch.zeros(1, 2, 5, 3), torch.zeros(1, 2, 5, 4), torch.zeros(1, 2, 5)
    GaussianAttributes(three, three, four, one, three)
    with pytest.raises(ValueError, match=r"GaussianAttributes\.quats"):
        GaussianAttributes(three, three, three, one, three)
    with pytest.raises(ValueError, match=r"GaussianAttributes\.opacities"):
        GaussianAttributes(three, three, four, one[..., None], three)


def test_images_of_a_rendering_have_one_size() -> None:
    rgb, alpha = torch.zeros(1, 2, 3, 4, 5), torch.zeros(1, 2, 1, 4, 5)
    with pytest.raises(ValueError, match=r"Rendering\.depth"):
        Rendering(rgb, alpha, alpha[..., :4])
    with pytest.raises(ValueError, match=r"Rendering\.rgb .*add a leading dimension for a single"):
        Rendering(rgb[0], alpha[0], alpha[0])


def test_support_has_three_axes() -> None:
    with pytest.raises(ValueError, match=r"SpatialSupport\.axes"):
        SpatialSupport(torch.zeros(1, 2, 3), torch.zeros(1, 2, 3))


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
