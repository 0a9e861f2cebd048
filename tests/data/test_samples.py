import numpy as np
import torch
from line_scenes import DOWN, Line, Lines, drawn, judged_samples, samples_of, values
from odd_views import odd_views
from tables import assert_equal, assert_near, must_refuse
from torch.testing import assert_close
from walk import arc, assert_rigid

from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.samples import collate, make_sample, mirrored_views, stack_views
from qgs.data.view_samplers import Span
from qgs.evaluate.plan import held_out_windows
from qgs.evaluate.protocol import protocol_of
from qgs.geometry.poses import look_at, look_at_depth
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.recipe import resolve
from qgs.tokengs.schedules import Linear

MASKS = values(range(6)) * (torch.arange(8) < 4).expand(1, 1, 1, 8, 8)
"""Want only the left half of frame f modelled, f in percent."""


def sample(scene, inputs=(1, 4), targets=(3,), mirror=False, rng=None, **views):
    return make_sample(
        scene, inputs, targets, ViewsConfig(inputs=len(inputs), **views), mirror, rng
    )


def test_frames_follow_the_rules():
    scene = Line(20, held_out=(4, 12))
    usable = [f for f in range(20) if f not in scene.held_out]
    for inputs, gap, expected in (
        (2, (2, 5), range(2, 6)),
        (4, (5, 9), range(5, 10)),
        (1, (3, 3), [0]),
        (3, (50, 90), [17]),
    ):
        views = ViewsConfig(inputs=inputs, targets=3, gap=gap)
        gaps = set()
        for seed in range(60):
            chosen, targets = drawn(scene, views, seed)
            assert list(chosen) == sorted(set(chosen))
            assert len(chosen) == inputs
            assert len(targets) == 3
            assert {*chosen, *targets} <= {*usable}
            found = usable.index(chosen[-1]) - usable.index(chosen[0])
            gaps.add(found)
            assert inputs == 1 or chosen[0] <= min(targets) <= max(targets) <= chosen[-1]
            assert len({*targets} - {*chosen}) >= min(3, found - inputs + 1), "novel ones first"
        assert gaps == {*expected}


def test_normalised_poses():
    scene = Line(9)

    def made(**views):
        both = sample(scene, (2, 6), (4,), **views)
        return torch.cat([both.inputs.cameras.c2w[0], both.targets.cameras.c2w[0]])

    constant = made(scale_factor=0.4)
    assert_equal(constant[0], torch.eye(4))
    assert_near(constant[1:, 0, 3], [4 * 0.5 * 0.4, 2 * 0.5 * 0.4])
    config = {"scale": "distance", "scale_factor": 1.0, "frame": "mean_cam"}
    assert_near(made(**config)[:2, 0, 3], [-0.5, 0.5])
    must_refuse("one point", sample, Line(5, step=0.0), **config)
    assert_equal(made(scale_factor=1.0, frame="given"), scene.cameras.c2w[[2, 6, 4]].float())


def test_a_mirrored_camera_sees_the_mirrored_point_in_the_mirrored_pixel():
    plain = odd_views(2, 8, 8)
    flipped = mirrored_views(plain)
    assert_equal(flipped.images, plain.images.flip(-1))
    assert_close(torch.linalg.det(flipped.cameras.c2w), torch.ones(2, 2))
    point = torch.tensor([0.7, -0.2, 4.0]).expand(2, 1, 3)
    expected = to_camera(point, plain.cameras)
    seen = to_camera(point * torch.tensor([-1, 1, 1]), flipped.cameras)
    assert_close(seen[..., 2], expected[..., 2])
    x, y = to_pixels(expected, plain.cameras.intrinsics).unbind(-1)
    assert_close(to_pixels(seen, flipped.cameras.intrinsics), torch.stack([8 - x, y], -1))


def test_masks_follow_their_frames_into_mirrors_and_batches():
    masked = Line(6, masks=MASKS)
    plain, flipped = (sample(masked, targets=(3, 2), mirror=m) for m in (False, True))
    assert_near(plain.targets.masks[0, :, 0, 5, 0], [0.03, 0.02])
    assert_close(flipped.targets.masks, plain.targets.masks.flip(-1))
    bare = sample(Line(6), targets=(3, 2))
    assert collate([bare, bare]).inputs.masks is None
    mixed = collate([plain, bare]).inputs.masks
    assert_equal(mixed[0], plain.inputs.masks[0])
    assert_equal(mixed[1], torch.ones(2, 1, 8, 8))


def test_poses_far_from_the_origin_keep_their_digits():
    c2w = Line(6).cameras.c2w
    c2w[:, :3, 3] += 1e6
    scenes = (Line(6), Line(6, c2w=c2w))
    near, far = (sample(scene, scale_factor=1.0).inputs.cameras for scene in scenes)
    assert far.c2w.dtype == far.intrinsics.dtype == torch.float32
    assert_equal(far.c2w, near.c2w, atol=1e-7)


def test_too_few_frames_and_a_gap_too_short_are_explained():
    must_refuse("line3", drawn, Line(3), ViewsConfig(inputs=4), 0)
    must_refuse(r"views\.gap", drawn, Line(30), ViewsConfig(inputs=6, gap=(2, 3)), 0)


def test_every_held_out_frame_is_a_target_once():
    scene = Line(40, held_out=tuple(range(4, 40, 8)))
    windows = held_out_windows(scene, ViewsConfig(inputs=3, gap=(5, 6)))
    assert sorted(f for _, targets in windows for f in targets) == list(scene.held_out)
    for inputs, targets in windows:
        assert len(inputs) == 3
        assert not {*inputs} & {*scene.held_out}
        assert inputs[0] < targets[0] <= targets[-1] < inputs[-1]


def test_evaluation_is_deterministic_novel_and_never_mirrored():
    def found(**options):
        views = ViewsConfig(inputs=2, gap=(3, 5), mirror=1.0)
        config = EvaluationConfig(scenes=2, samples=3, **options)
        return samples_of(Lines(Line(8), Line(9), Line(10)), views, config)

    chosen, again, others = ([s.input_frames for s in found(**o)] for o in ({}, {}, {"seed": 1}))
    assert chosen == again != others
    assert len(chosen) == 6
    for sample in found():
        low, high = sample.input_frames
        assert sample.target_frames == tuple(range(low + 1, high))
        assert sample.inputs.images[0, 0, 0, 0, 0] < sample.inputs.images[0, 0, 0, 0, -1]


AROUND = arc(torch.linspace(0, 172, 9), 4)
"""Cameras on a circle about the origin, at a distance of 4, that look at it."""


def test_auto_brings_what_all_cameras_look_at_to_depth_1(caplog):
    auto = {"scale": "auto", "scale_factor": 7.0}
    views = sample(Line(9, c2w=AROUND), (2, 3), (5,), **auto)
    for side in (views.inputs, views.targets):
        seen = side.cameras.w2c[0] @ torch.tensor([0.0, 0, 1, 1])
        assert_close(seen[:, 2], torch.ones(len(seen)))
    apart = sample(Line(9), (2, 3), (5,), **auto).inputs.cameras.c2w[0, 1, 0, 3]
    assert_near(apart, 1 / 8)  # of the scene's extent: the axes are parallel
    assert "'line9' look at no common point" in caplog.text
    must_refuse("line5", sample, Line(5, step=0.0), **auto)


def test_a_point_behind_or_beside_the_cameras_is_not_looked_at():
    assert_near(look_at_depth(AROUND), 4)
    outwards = AROUND * torch.tensor([-1, 1, -1, 1])
    assert look_at_depth(outwards) == 0
    assert_near(look_at_depth(torch.cat([AROUND, outwards[:1]])), 4, rtol=0.01)
    eyes = torch.tensor([[-200.0, 0, 0], [200, 0, 0], [0, 0, 0]])
    walk = look_at(eyes, torch.tensor([0.0, 0, 400]) - eyes, DOWN)
    assert_near(look_at_depth(walk[:2]), 200 * 5**0.5)
    assert look_at_depth(walk[:, :3]) == look_at_depth(walk)


def test_pose_noise_moves_inputs_but_the_first_and_nothing_else():
    """Rotations and directions from the first input are off by the angle, about every axis."""
    frames = Line(9), (1, 4, 7), (2, 5)
    plain = sample(*frames)
    rng = np.random.default_rng(0)
    noisy = [sample(*frames, rng=rng, pose_noise=2.0) for _ in range(400)]
    poses = torch.stack([sample.inputs.cameras.c2w[0] for sample in noisy])
    exact = plain.inputs.cameras.c2w[0]
    assert all(torch.equal(s.targets.cameras.c2w, plain.targets.cameras.c2w) for s in noisy)
    assert_equal(poses[:, 0], exact[:1].expand(400, 4, 4))
    off = torch.linalg.inv(exact[1:]) @ poses[:, 1:]
    assert_rigid(off)
    angles = torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)
    apart = (exact[1:, :3, 3] - exact[0, :3, 3]).norm(dim=-1, keepdim=True)
    for error in (angles, off[..., :3, 3] / apart):
        assert_near(torch.rad2deg(error).std(dim=(0, 1)), [2.0] * 3, rtol=0.15)


def test_pose_noise_of_an_evaluation_is_the_same_each_time_and_in_its_protocol():
    def first_inputs(recipe):
        return judged_samples(recipe)[0].inputs.cameras.c2w

    exact = resolve("recipes/tiny/tokengs.yaml", ["evaluation.scenes=1"])
    noisy = resolve(exact.tree, ["views.pose_noise=3"])
    assert_equal(first_inputs(noisy), first_inputs(noisy))
    assert not torch.equal(first_inputs(noisy), first_inputs(exact))
    assert protocol_of(noisy).content["poses"]["noise"] == [3.0, 0]
    assert "noise" not in protocol_of(exact).content["poses"]


def test_times_of_photos_are_kept():
    plain = sample(Line(9)).inputs
    timed = plain.replace(times=torch.rand(1, 2), target_time=torch.rand(1, 1))
    both = stack_views([mirrored_views(timed), timed])
    for name in ("times", "target_time"):
        assert_equal(getattr(both, name), getattr(timed, name).repeat(2, 1))
    must_refuse("target_time, times", stack_views, [timed, plain])


def test_a_schedule_moves_the_gap_of_the_default():
    sampler = Span(Span.Config(min_gap=2))
    sampler.schedules = {"max_gap": Linear(schedule="linear", values=(2, 10), at=(0, 100))}
    views = ViewsConfig(inputs=2, targets=3, gap=(2, 5))
    for step, largest in ((0, 2), (50, 6), (100, 10), (END, 10)):
        frames = (drawn(Line(30), views, seed, step, sampler) for seed in range(200))
        assert max(right - left for (left, right), _ in frames) == largest
