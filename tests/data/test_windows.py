"""Which photos become inputs, in walks, orbits and folders without order."""

import torch
import yaml
from line_scenes import Line
from tables import assert_near, must_refuse
from textured_room import photos_of, walk
from walk import along_x, arc

from qgs.data.inputs import Frusta, ranked_windows, scene_depth, trained_ratios
from qgs.domain import Domain
from qgs.reconstruction.scenes import GivenScene

TRAINED = Domain(yaml.safe_load("{baseline: [0.1, 0.3], turn: [2.0, 20.0], depth: [1.0, 1.0]}"))


def scene_of(c2w, held_out=()):
    return Line(len(c2w), held_out, c2w=c2w)


def orbit(count, step, radius=4.0):
    return arc(torch.arange(count) * step, radius)


def windows_of(scene, count=1, inputs=2):
    frusta = Frusta(scene, TRAINED)
    ranked = ranked_windows(frusta, inputs)[:count]
    return [(chosen, frusta.compared(chosen, target)) for _, chosen, target in ranked]


def test_any_number_of_inputs_that_are_not_held_out():
    for held_out, count in (((), 3), ((3, 11), 24), ((), 24)):
        scene = scene_of(orbit(count, 6.0), held_out)
        for inputs in {1, 2, 3, min(5, count)}:
            windows = windows_of(scene, 6, inputs)
            assert bool(windows) == (inputs < count)
            for chosen, targets in windows:
                assert len({*chosen}) == inputs
                assert not {*chosen} & {*held_out, *targets}
                assert {*targets} <= {*(held_out or range(count))}
                assert targets
    must_refuse("too few", windows_of, scene_of(orbit(3, 6.0)), 1, 5)


def test_inputs_of_an_orbit_stand_beside_a_held_out_photo_in_any_order():
    poses = orbit(36, 5.0)
    held_out = (4, 20, 32)
    windows = windows_of(scene_of(poses, held_out), 3)
    assert {target for _, targets in windows for target in targets} == {*held_out}
    for (first, last), targets in windows:
        assert 1 < abs(last - first) <= 4
        assert any(min(first, last) < target < max(first, last) for target in targets)
    order = torch.randperm(36)
    shuffled = scene_of(poses[order], order.argsort()[list(held_out)].tolist())
    again = [{*order[list(chosen)].tolist()} for chosen, _ in windows_of(shuffled, 3)]
    assert sorted(again, key=min) == sorted(({*chosen} for chosen, _ in windows), key=min)


def test_inputs_are_as_far_apart_as_in_training_whatever_the_unit():
    low, high, turn = trained_ratios(TRAINED)
    for unit in (1.0, 100.0):
        c2w = orbit(30, 2.0, 4.0 * unit)
        (((first, last), _),) = windows_of(scene_of(c2w, (15,)))
        assert low <= (c2w[first] - c2w[last])[:3, 3].norm() / (4 * unit) <= high
        assert 2 * abs(first - last) <= turn


def test_a_third_input_stands_between_two():
    frusta = Frusta(scene_of(along_x([0.0, 0.1, 0.2, 0.3, 0.4, 0.9])), TRAINED, 1.0)
    assert frusta.with_middle((0, 4), (5,)) == (0, 2, 4)
    assert frusta.with_middle((4, 0), (2, 5)) in ((4, 1, 0), (4, 3, 0))
    for window in ((0, 1), (0, 2, 4)):
        assert frusta.with_middle(window, ()) == window


def test_a_training_with_all_distances_says_nothing_about_the_best():
    ranges = "{baseline: [0.002, 0.9], turn: [0.4, 43.0], depth: [0.002, 4.0]}"
    assert trained_ratios(Domain(yaml.safe_load(ranges), 512)) == trained_ratios(Domain())


def test_photos_that_look_elsewhere_are_no_inputs():
    away = orbit(12, 5.0)
    away[::2, :3, :3] *= torch.tensor([-1.0, 1, -1])
    ((chosen, _),) = windows_of(scene_of(away, (5,)))
    assert all(frame % 2 for frame in chosen)


def test_the_depth_of_a_walk_is_seen_in_its_photos():
    # walls at 1.5, seen from -1.1 to -0.6 along the axis
    assert 1.5 < scene_depth(GivenScene(photos_of(walk(6)))) < 2.7


def test_photos_without_texture_leave_the_reach_of_the_cameras():
    assert scene_depth(scene_of(along_x([0.0] * 9))) == 1.0
    assert_near(scene_depth(scene_of(along_x(0.5 * torch.arange(9)))), 4.0)
