"""What stands in a memory token and in the two streams at the start, channel by channel."""

import math

import pytest
import torch
from globalsplat_inputs import DIMS, cameras, views
from qgs_globalsplat.encoder import PosedPatches, lens, place
from qgs_globalsplat.streams import TEXTURE, SlotQueries

from qgs.contracts import RecipeContext
from qgs.geometry.rays import plucker_rays
from qgs.types import ImageMemory

OPTIONS = {"patch_size": 4, "rgb_width": 6, "ray_width": 5, "lens_width": 3, "bands": 2}


def test_a_token_is_its_colours_beside_its_rays_and_its_camera() -> None:
    torch.manual_seed(0)
    encoder, given = PosedPatches(PosedPatches.Config(**OPTIONS), DIMS), views()
    memory = encoder(given)
    assert memory.features.shape == (2, 2 * 3 * 4 + 4, 11)
    assert memory.grid is memory.keys is memory.patch_rays is None
    scene, view, row, column = 1, 1, 2, 3
    patch = (scene, view, slice(None), slice(8, 12), slice(12, 16))
    token = memory.features[scene, view * 12 + row * 4 + column]
    colours = 2 * given.images[patch] - 1
    rgb = encoder.rgb_embedding.weight.flatten(1) @ colours.flatten()
    torch.testing.assert_close(token[:6], rgb)
    rays = encoder.ray_embedding.weight.flatten(1) @ plucker_rays(given.cameras)[patch].flatten()
    told = torch.tensor([math.log(20 / 16), math.log(18 / 12), 7 / 16, 6.5 / 12])
    x = given.cameras.c2w[scene, view, :3, 3]
    waves = [f(k * math.pi * x) for f in (torch.sin, torch.cos) for k in (1, 2)]
    camera = torch.cat([encoder.lens_mlp(told), x, *waves])
    torch.testing.assert_close(token[6:], rays + encoder.camera_proj(camera))
    assert torch.equal(memory.features[0, -4:], encoder.registers)
    assert encoder.rgb_embedding.bias is encoder.ray_embedding.bias is None


def test_published_sizes_of_what_a_camera_tells() -> None:
    assert lens(cameras()).shape[-1] == 4
    assert place(cameras(), 4).shape[-1] == 27
    config = PosedPatches.Config()
    assert PosedPatches.fields_written(config)["memory.features"].shape == (768,)
    assert PosedPatches(config, DIMS).camera_proj.weight.shape == (256, 64 + 27)


def test_patches_go_with_their_views_and_registers_stay() -> None:
    torch.manual_seed(0)
    encoder, given = PosedPatches(PosedPatches.Config(**OPTIONS), DIMS), views(3)
    order = [2, 0, 1]
    one, other = encoder(given).features, encoder(given.select(order)).features
    torch.testing.assert_close(
        other[:, :-4].unflatten(1, (3, -1)), one[:, :-4].unflatten(1, (3, -1))[:, order]
    )
    assert torch.equal(other[:, -4:], one[:, -4:])


def test_without_registers_there_is_a_grid() -> None:
    memory = PosedPatches(PosedPatches.Config(**OPTIONS, registers=0), DIMS)(views())
    assert memory.grid == (2, 3, 4)


def test_images_that_patches_do_not_divide_are_refused() -> None:
    config = PosedPatches.Config(patch_size=5)
    (problem,) = PosedPatches.problems(config, RecipeContext(DIMS, (12, 16)))
    assert "patches of 5 do not divide images of 12 x 16" in problem.reason
    with pytest.raises(ValueError, match="12 x 16 cannot be cut into patches of 5; resize"):
        PosedPatches(config, DIMS)(views())


def test_two_streams_of_one_token() -> None:
    torch.manual_seed(0)
    queries = SlotQueries(SlotQueries.Config(count=400, extra=4, std=0.5), DIMS)
    assert queries.slots.std().item() == pytest.approx(0.5, rel=0.05)
    state = queries(ImageMemory(torch.zeros(3, 1, 7)), views())
    assert state.features.shape == state[TEXTURE].shape == (3, 400, 16)
    for number, token in ((7, queries.slots[7]), (398, queries.extra[2])):
        normed = (token - token.mean()) / (token.var(correction=0) + 1e-5).sqrt()
        for stream, seen in ((queries.geometry, state.features), (queries.texture, state[TEXTURE])):
            norm, linear = stream
            wanted = linear.weight @ (normed * norm.weight + norm.bias) + linear.bias
            torch.testing.assert_close(seen[2, number], wanted)
    assert state.mask.sum(1).tolist() == [396] * 3
    assert state.mask[:, :396].all()
    plain = SlotQueries(SlotQueries.Config(count=4, extra=0), DIMS)
    assert plain.start(2).mask is None


def test_extra_tokens_stay_extra_when_slots_are_added() -> None:
    few = SlotQueries(SlotQueries.Config(count=6, extra=2), DIMS)
    many = SlotQueries(SlotQueries.Config(count=12, extra=2), DIMS)
    many.load_state_dict(many.resized(few.state_dict(), torch.Generator().manual_seed(0)))
    assert torch.equal(many.extra, few.extra)
    assert torch.equal(many.slots[:4], few.slots)
    torch.testing.assert_close(many.slots[4:8], few.slots, atol=0.06, rtol=0)
