"""Which photos become inputs, in walks, orbits and folders without order."""

import math

import pytest
import textured_room
import torch

from qgs.analysis.scenes import GivenScene
from qgs.contracts import ViewsConfig
from qgs.data.depth import scene_depth
from qgs.data.domain import Domain
from qgs.data.inputs import choose_windows, trained_ratios
from qgs.geometry.poses import look_at
from qgs.types import Cameras, Views

TRAINED = Domain({"baseline": [0.1, 0.3], "turn": [2.0, 20.0], "depth": [1.0, 1.0]})
DOWN = torch.tensor([0.0, 1.0, 0.0])


def scene_of(c2w, images=None, focal=64.0, held_out=()):
    images = torch.full((len(c2w), 3, 64, 64), 0.5) if images is None else images
    lens = torch.tensor([focal, focal, images.shape[3] / 2, images.shape[2] / 2])
    cameras = Cameras(c2w[None].float(), lens.expand(1, len(c2w), 4), tuple(images.shape[2:]))
    scene = GivenScene(Views(images[None], cameras))
    scene.held_out = held_out
    return scene


def orbit(count, step, radius=4.0):
    """Cameras around the origin, `step` degrees apart."""
    angles = torch.arange(count) * math.radians(step)
    axes = torch.stack([angles.sin(), torch.zeros(count), angles.cos()], -1)
    return look_at(-radius * axes, axes, DOWN.expand(count, 3))


def line(count, step):
    """Cameras side by side that look the same way."""
    c2w = torch.eye(4).repeat(count, 1, 1)
    c2w[:, 0, 3] = step * torch.arange(count)
    return c2w


def views(inputs=2):
    return ViewsConfig(inputs=inputs, gap=(1, 9))


@pytest.mark.parametrize("inputs", [1, 2, 3, 5])
@pytest.mark.parametrize(("held_out", "count"), [((), 3), ((3, 11), 24), ((), 24)])
def test_any_number_of_inputs_that_are_not_held_out(inputs, held_out, count):
    scene = scene_of(orbit(count, 6.0), held_out=held_out)
    if inputs > count:
        with pytest.raises(ValueError, match="too few"):
            choose_windows(scene, views(inputs), TRAINED)
        return
    windows = choose_windows(scene, views(inputs), TRAINED, 6)
    assert windows == choose_windows(scene, views(inputs), TRAINED, 6)
    assert windows[:1] == choose_windows(scene, views(inputs), TRAINED)
    for chosen, targets in windows:
        assert len({*chosen}) == inputs
        assert not {*chosen} & {*held_out, *targets}
        assert {*targets} <= {*(held_out or range(count))}
        assert targets or inputs == count


def test_inputs_of_an_orbit_stand_beside_a_held_out_photo_in_any_order():
    poses, held_out = orbit(36, 5.0), (4, 20, 32)
    order = torch.randperm(36, generator=torch.manual_seed(0))
    place = {int(frame): i for i, frame in enumerate(order)}
    windows = choose_windows(scene_of(poses, held_out=held_out), views(), TRAINED, 3)
    shuffled = scene_of(poses[order], held_out=tuple(sorted(place[f] for f in held_out)))
    others = choose_windows(shuffled, views(), TRAINED, 3)
    assert {t for _, targets in windows for t in targets} == {*held_out}
    for (first, last), targets in windows:
        assert 1 < abs(last - first) <= 4
        assert any(min(first, last) < target < max(first, last) for target in targets)
    again = {frozenset(int(order[f]) for f in chosen) for chosen, _ in others}
    assert again == {frozenset(chosen) for chosen, _ in windows}


@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_inputs_are_as_far_apart_as_in_training_whatever_the_unit(unit):
    c2w = orbit(30, 2.0, 4.0 * unit)
    ((chosen, _),) = choose_windows(scene_of(c2w, held_out=(15,)), views(), TRAINED)
    (low, high), turn = trained_ratios(TRAINED)
    first, last = c2w[list(chosen)]
    assert low <= float((first - last)[:3, 3].norm()) / (4 * unit) <= high
    assert 2 * abs(chosen[0] - chosen[1]) <= turn


def test_a_training_with_all_distances_says_nothing_about_the_best():
    varied = Domain({"baseline": [0.002, 0.9], "turn": [0.4, 43.0], "depth": [0.002, 4.0]}, 512)
    assert trained_ratios(varied) == trained_ratios(Domain())


def test_photos_that_look_elsewhere_are_no_inputs():
    away = orbit(12, 5.0)
    away[::2, :3, :3] = away[::2, :3, :3] @ torch.diag(torch.tensor([-1.0, 1, -1]))
    windows = choose_windows(scene_of(away, held_out=(5,)), views(), TRAINED)
    assert all(frame % 2 for chosen, _ in windows for frame in chosen)


def test_the_depth_of_a_walk_is_seen_in_its_photos():
    shots = textured_room.walk(12)
    images = torch.stack([torch.from_numpy(s.image).permute(2, 0, 1) / 255 for s in shots])
    c2w = torch.stack([torch.from_numpy(s.c2w) for s in shots])
    found = scene_depth(scene_of(c2w, images, textured_room.INTRINSICS[0]))
    # walls at 1.5, seen from -1.1 to -0.6 along the axis
    assert 1.5 < found < 2.7


def test_photos_without_texture_leave_the_reach_of_the_cameras():
    assert scene_depth(scene_of(line(9, 0.5))) == pytest.approx(4.0)
    assert scene_depth(scene_of(torch.eye(4).repeat(3, 1, 1))) == 1.0
