from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from line_scenes import Line, Lines

from qgs.composer import resolve
from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.data.evaluation import evaluation_samples, held_out_windows
from qgs.data.samples import collate, draw_frames, make_sample, mirrored_views, stack_views
from qgs.data.stream import training_batches
from qgs.engine.protocol import protocol_of
from qgs.geometry.poses import look_at, look_at_depth
from qgs.types import Cameras, Views


class MaskedLine(Line):
    """A line that wants only the left half of frame f modelled, f in percent; float64 poses."""

    @property
    def cameras(self):
        return super().cameras.to(torch.float64)

    def masks(self, frames):
        value = torch.tensor(list(frames)).float() / 100
        left = torch.arange(8) < 4
        return value[:, None, None, None] * left.expand(1, 8, 8)


@pytest.mark.parametrize(("inputs", "gap"), [(2, (2, 5)), (4, (5, 9)), (1, (3, 3)), (3, (50, 90))])
def test_frames_follow_the_rules(inputs, gap):
    views = ViewsConfig(inputs=inputs, targets=3, gap=gap)
    scene = Line(20, held_out=(4, 12))
    usable = [f for f in range(20) if f not in scene.held_out]
    gaps = set()
    for seed in range(60):
        chosen, targets = draw_frames(scene, views, np.random.default_rng(seed))
        assert list(chosen) == sorted(set(chosen))
        assert len(chosen) == inputs
        assert len(targets) == 3
        assert not set(scene.held_out) & {*chosen, *targets}
        if inputs > 1:
            gaps.add(usable.index(chosen[-1]) - usable.index(chosen[0]))
            assert chosen[0] <= min(targets) <= max(targets) <= chosen[-1]
    if inputs > 1:
        assert gaps == set(range(min(gap[0], 17), min(gap[1], 17) + 1))


def test_targets_are_novel_while_there_are_enough():
    views = ViewsConfig(inputs=2, targets=3, gap=(4, 4))
    for seed in range(20):
        inputs, targets = draw_frames(Line(9), views, np.random.default_rng(seed))
        assert len({*inputs, *targets}) == 5


def test_only_a_scene_whose_masks_are_all_black_is_refused():
    assert make_sample(MaskedLine(2), (0,), (0,), ViewsConfig(inputs=1), False).targets is not None
    with pytest.raises(ValueError, match="line1"):
        make_sample(MaskedLine(1), (0,), (0,), ViewsConfig(inputs=1), False)


def test_normalised_poses():
    scene = Line(9)
    first = make_sample(scene, (2, 6), (4,), ViewsConfig(inputs=2, scale_factor=0.4), False)
    assert torch.equal(first.inputs.cameras.c2w[0, 0], torch.eye(4))
    assert first.inputs.cameras.c2w[0, 1, 0, 3] == pytest.approx(4 * 0.5 * 0.4)
    assert first.targets.cameras.c2w[0, 0, 0, 3] == pytest.approx(2 * 0.5 * 0.4)
    config = ViewsConfig(inputs=2, scale="distance", scale_factor=1.0, frame="mean_cam")
    mean = make_sample(scene, (2, 6), (4,), config, False)
    centres = mean.inputs.cameras.c2w[0, :, 0, 3]
    assert centres.tolist() == pytest.approx([-0.5, 0.5])
    with pytest.raises(ValueError, match="one point"):
        make_sample(Line(5, step=0.0), (0, 3), (1,), config, False)
    stay = ViewsConfig(inputs=2, scale_factor=1.0, frame="given")
    given = make_sample(scene, (2, 6), (4,), stay, False)
    assert torch.equal(given.inputs.cameras.c2w[0], scene.cameras.c2w[[2, 6]])
    assert torch.equal(given.targets.cameras.c2w[0], scene.cameras.c2w[[4]])


def test_mirroring_flips_images_poses_and_principal_point():
    plain = make_sample(Line(5), (0, 3), (1,), ViewsConfig(inputs=2), False).inputs
    flipped = mirrored_views(plain)
    assert torch.equal(flipped.images, plain.images.flip(-1))
    assert flipped.cameras.intrinsics[0, 0].tolist() == [8, 8, 5, 4]
    assert flipped.cameras.c2w[0, 1, 0, 3] == -plain.cameras.c2w[0, 1, 0, 3]


def test_a_mirrored_camera_sees_the_mirrored_point_in_the_mirrored_pixel():
    axes = torch.tensor([[0.3, -0.8, 0.2], [-0.5, 0.1, 0.9]], dtype=torch.float64)
    c2w = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    c2w[:, :3, :3] = torch.linalg.matrix_exp(
        torch.linalg.cross(axes[:, None], torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    )
    c2w[:, :3, 3] = torch.tensor([[0.2, 0.1, -3.0], [-0.4, 0.3, -2.0]])
    intrinsics = torch.tensor([8.0, 9, 3, 4], dtype=torch.float64).expand(2, 4)
    plain = Views(torch.rand(1, 2, 3, 8, 8), Cameras(c2w[None], intrinsics[None], (8, 8)))
    flipped = mirrored_views(plain).cameras
    assert torch.linalg.det(flipped.c2w[0, :, :3, :3]).tolist() == pytest.approx([1, 1])
    point = torch.tensor([0.7, -0.2, 4.0, 1.0], dtype=torch.float64)
    x, y, depth = projected(plain.cameras, point).unbind(-1)
    mirror = torch.tensor([-1.0, 1, 1, 1], dtype=torch.float64)
    expected = torch.stack([8 - x, y, depth], -1)
    torch.testing.assert_close(projected(flipped, mirror * point), expected)


def projected(cameras, point):
    """x, y in pixels and depth of a homogeneous world point in each camera."""
    x, y, z, _ = (torch.linalg.inv(cameras.c2w) @ point).unbind(-1)
    fx, fy, cx, cy = cameras.intrinsics.unbind(-1)
    return torch.stack([fx * x / z + cx, fy * y / z + cy, z], -1)


def test_masks_follow_their_frames_into_mirrors_and_batches():
    config = ViewsConfig(inputs=2)
    plain = make_sample(MaskedLine(6), (1, 4), (3, 2), config, False)
    assert plain.targets.masks is not None
    assert plain.targets.masks[0, :, 0, 5, 0].tolist() == pytest.approx([0.03, 0.02])
    flipped = make_sample(MaskedLine(6), (1, 4), (3, 2), config, True)
    torch.testing.assert_close(flipped.targets.masks, plain.targets.masks.flip(-1))
    bare = make_sample(Line(6), (1, 4), (3, 2), config, False)
    assert collate([bare, bare]).inputs.masks is None
    mixed = collate([plain, bare]).inputs.masks
    assert mixed is not None
    assert mixed.shape == (2, 2, 1, 8, 8)
    assert torch.equal(mixed[0], plain.inputs.masks[0])
    assert (mixed[1] == 1).all()


def test_poses_far_from_the_origin_keep_their_digits():
    class Far(MaskedLine):
        @property
        def cameras(self):
            near = super().cameras
            c2w = near.c2w.clone()
            c2w[:, :3, 3] += 1e6
            return Cameras(c2w, near.intrinsics, near.size)

    config = ViewsConfig(inputs=2, scale_factor=1.0)
    near, far = (make_sample(kind(6), (1, 4), (3,), config, False) for kind in (MaskedLine, Far))
    assert far.inputs.cameras.c2w.dtype == far.inputs.cameras.intrinsics.dtype == torch.float32
    torch.testing.assert_close(far.inputs.cameras.c2w, near.inputs.cameras.c2w, rtol=0, atol=1e-7)


def test_too_few_frames_and_a_gap_too_short_are_explained():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="line3"):
        draw_frames(Line(3), ViewsConfig(inputs=4), rng)
    with pytest.raises(ValueError, match=r"views\.gap"):
        draw_frames(Line(30), ViewsConfig(inputs=6, gap=(2, 3)), rng)


def test_every_held_out_frame_is_a_target_once():
    scene = Line(40, held_out=tuple(range(4, 40, 8)))
    windows = held_out_windows(scene, ViewsConfig(inputs=3, gap=(5, 6)))
    assert sorted(f for _, targets in windows for f in targets) == list(scene.held_out)
    for inputs, targets in windows:
        assert len(inputs) == 3
        assert not set(inputs) & set(scene.held_out)
        assert inputs[0] < targets[0] <= targets[-1] < inputs[-1]


def test_evaluation_is_deterministic_novel_and_never_mirrored():
    source = Lines(Line(8), Line(9), Line(10))
    views = ViewsConfig(inputs=2, gap=(3, 5), mirror=1.0)
    config = EvaluationConfig(scenes=2, samples=3)
    first, again = (evaluation_samples(source, views, config) for _ in range(2))
    other = evaluation_samples(source, views, config.model_copy(update={"seed": 1}))
    drawn, same, others = ([s.input_frames for s in found] for found in (first, again, other))
    assert drawn == same
    assert drawn != others
    assert len(first) == 6
    for sample in first:
        low, high = sample.input_frames
        assert sample.target_frames == tuple(range(low + 1, high))
        assert sample.inputs.images[0, 0, 0, 0, 0] < sample.inputs.images[0, 0, 0, 0, -1]


def test_training_resumes_exactly():
    source = Lines(*(Line(n) for n in range(8, 13)))
    views = ViewsConfig(inputs=2, targets=3, gap=(2, 5))
    through = list(islice(training_batches(source, views, 2, seed=3), 8))
    resumed = list(islice(training_batches(source, views, 2, seed=3, start=5), 3))
    for a, b in zip(through[5:], resumed, strict=True):
        assert a.scenes == b.scenes
        assert torch.equal(a.inputs.images, b.inputs.images)
        assert torch.equal(a.targets.cameras.c2w, b.targets.cameras.c2w)
    names = [name for batch in through for name in batch.scenes][:5]
    assert len(set(names)) == 5, "an epoch visits every scene once"
    assert through[0].inputs.images.is_contiguous()
    assert through[0].targets.images.shape == (2, 3, 3, 8, 8)


class Around(Line):
    """Cameras on a circle about the origin, at a distance of 4, that look at it."""

    @property
    def cameras(self):
        angles = torch.linspace(0, 3, self.count, dtype=torch.float64)
        eyes = 4 * torch.stack([angles.sin(), 0 * angles, -angles.cos()], -1)
        c2w = look_at(eyes, -eyes, torch.tensor([0.0, 1, 0]).expand_as(eyes).double())
        return Cameras(c2w, torch.tensor([8.0, 8, 3, 4]).expand(self.count, 4), (8, 8))


def test_auto_brings_what_all_cameras_look_at_to_depth_1(caplog):
    views = ViewsConfig(inputs=2, scale="auto", scale_factor=7.0)
    sample = make_sample(Around(9), (2, 3), (5,), views, False)
    for side in (sample.inputs, sample.targets):
        seen = side.cameras.w2c[0] @ torch.tensor([0.0, 0, 1, 1])
        torch.testing.assert_close(seen[:, 2], torch.ones(len(seen)))
    apart = make_sample(Line(9), (2, 3), (5,), views, False).inputs.cameras.c2w[0, 1, 0, 3]
    assert apart == pytest.approx(1 / 8)  # of the scene's extent: the axes are parallel
    assert "'line9' look at no common point" in caplog.text
    with pytest.raises(ValueError, match="line5"):
        make_sample(Line(5, step=0.0), (0, 3), (1,), views, False)


def test_a_point_behind_or_beside_the_cameras_is_not_looked_at():
    around = Around(9).cameras.c2w
    assert look_at_depth(around) == pytest.approx(4)
    outwards = around @ torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()
    assert look_at_depth(outwards) == 0
    one_astray = torch.cat([around, outwards[:1]])
    assert look_at_depth(one_astray) == pytest.approx(4, rel=0.01)
    sides = torch.tensor([-20.0, 20, 0])
    walk = torch.eye(4).repeat(3, 1, 1)
    walk[:, 0, 3] = 10 * sides
    walk[:, :3, :3] = look_at(
        torch.zeros(3, 3), torch.stack([-sides / 40, 0 * sides, 1 + 0 * sides], -1),
        torch.tensor([0.0, 1, 0]).expand(3, 3),
    )[:, :3, :3]  # fmt: skip
    assert look_at_depth(walk[:2]) == pytest.approx(200 * 5**0.5)
    assert look_at_depth(walk[:, :3]) == look_at_depth(walk)


def test_pose_noise_moves_inputs_but_the_first_and_nothing_else():
    """Rotations and directions from the first input are off by the angle, about every axis."""
    scene, views = Line(9), ViewsConfig(inputs=3, pose_noise=2.0)
    plain = make_sample(scene, (1, 4, 7), (2, 5), views, False)
    rng = np.random.default_rng(0)
    noisy = [make_sample(scene, (1, 4, 7), (2, 5), views, False, rng) for _ in range(400)]
    poses = torch.stack([sample.inputs.cameras.c2w[0] for sample in noisy])
    exact = plain.inputs.cameras.c2w[0]
    assert all(torch.equal(s.targets.cameras.c2w, plain.targets.cameras.c2w) for s in noisy)
    assert torch.equal(poses[:, 0], exact[:1].expand(400, 4, 4))
    turned = exact[1:, :3, :3].mT @ poses[:, 1:, :3, :3]
    assert torch.allclose(turned @ turned.mT, torch.eye(3).expand_as(turned), atol=1e-5)
    angles = torch.rad2deg(torch.stack([turned[..., 2, 1], turned[..., 0, 2], turned[..., 1, 0]]))
    assert angles.std(dim=(1, 2)) == pytest.approx([2.0] * 3, rel=0.15)
    apart = (exact[1:, :3, 3] - exact[0, :3, 3]).norm(dim=-1, keepdim=True)
    moved = torch.rad2deg((poses[:, 1:, :3, 3] - exact[1:, :3, 3]) / apart)
    assert moved.std(dim=(0, 1)) == pytest.approx([2.0] * 3, rel=0.15)


def test_pose_noise_of_an_evaluation_is_the_same_each_time_and_in_its_protocol():
    recipe = resolve("recipes/tiny/tokengs.yaml", ["views.pose_noise=3", "evaluation.scenes=2"])
    source = recipe.build_data()
    first, second = (
        [s.inputs.cameras.c2w for s in evaluation_samples(source, recipe.views, recipe.evaluation)]
        for _ in range(2)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    exact = resolve("recipes/tiny/tokengs.yaml", ["evaluation.scenes=2"])
    clean = evaluation_samples(source, exact.views, exact.evaluation)
    assert not torch.equal(first[0], clean[0].inputs.cameras.c2w)
    assert protocol_of(recipe).content["poses"]["noise"] == [3.0, 0]
    assert "noise" not in protocol_of(exact).content["poses"]


def test_times_of_photos_are_kept():
    plain = make_sample(Line(9), (1, 4, 7), (2,), ViewsConfig(inputs=3), False).inputs
    timed = replace(plain, times=torch.rand(1, 3), target_time=torch.rand(1, 1))
    both = stack_views([mirrored_views(timed), timed])
    for name in ("times", "target_time"):
        assert torch.equal(getattr(both, name), getattr(timed, name).repeat(2, 1))
    with pytest.raises(ValueError, match="target_time, times"):
        stack_views([timed, plain])
