"""Samplers of views: gaps and inputs that follow the training, and photos in any order."""

from functools import partial

import numpy as np
import torch
from line_scenes import Line, Lines, drawn, judged_samples, samples_of
from qgs_photos.datasets.view_samplers import Bounded, Farthest, Overlapping
from tables import must_refuse
from training_runs import batches, stream_of
from walk import along_x, arc

from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.contracts.schedule import END
from qgs.data.stream import trained_domain
from qgs.recipe import resolve

TWO = ViewsConfig(inputs=2, targets=3, gap=(2, 5))
SIX = ViewsConfig(inputs=6, targets=8)


def made(sampler, **options):
    return sampler(sampler.Config(**options))


warming = partial(made, warm_up_steps=100)
bounded = partial(
    warming, Bounded, min_gap=6, max_gap=12, initial_min_gap=4, initial_max_gap=6, margin=1
)
farthest = partial(
    warming, Farthest, min_gap=20, max_gap=50, initial_min_gap=15, initial_max_gap=30
)


def test_the_gap_widens_as_in_pixelsplat():
    """initial + int((final - initial) * step / warm_up_steps), at most the final number."""
    steps = {0: (4, 6), 50: (5, 9), 99: (5, 11), 100: (6, 12), 500: (6, 12), END: (6, 12)}
    for step, bounds in steps.items():
        gaps = set()
        places = set()
        for seed in range(120):
            (left, right), targets = drawn(Line(30), TWO, seed, step, bounded())
            gaps.add(right - left)
            places.update(target - left for target in targets)
            assert max(targets) < right
            assert len(targets) == 3
        assert (min(gaps), max(gaps)) == bounds
        assert min(places) == 1


def test_short_scenes_and_several_inputs():
    assert drawn(Line(5), TWO, 0, END, bounded())[0] == (0, 4)
    must_refuse("5 frames", drawn, Line(5), TWO, 0, END, bounded(margin=3))
    inputs, _ = drawn(Line(30), ViewsConfig(inputs=4, targets=1), 0, END, bounded())
    assert len(inputs) == 4
    assert list(inputs) == sorted({*inputs})


def small(*options):
    return resolve("tiny/tokengs_bounded.yaml", [*options, "data.image_size=[16, 16]"])


def in_steps(recipe, start, count):
    """Two samples a batch, two batches a step."""
    return batches(stream_of(recipe, per_step=4), count, 2, start=start)


def test_a_training_widens_the_gap_and_resumes_where_it_was():
    """The warm-up of 5 steps ends with sample 20."""
    recipe = small("view_sampler.warm_up_steps=5", "view_sampler.initial_max_gap=2")

    def gaps(start, count):
        found = [inputs for batch in in_steps(recipe, start, count) for inputs, _ in batch.windows]
        return [frames[-1] - frames[0] for frames in found]

    whole = gaps(0, 14)
    assert gaps(9, 5) == whole[18:]
    assert {*whole[:4]} == {2}
    assert max(whole[4:]) > 3
    sampler = recipe.build_view_sampler()
    for number, gap in enumerate(whole):
        low, high = sampler.gaps(number // 4)
        assert low <= gap <= high
    samples = judged_samples(recipe)
    found = [sample.input_frames[-1] - sample.input_frames[0] for sample in samples]
    assert min(found) in {3, 7}
    assert max(found) > 3


def test_numbers_of_inputs_and_gaps_as_in_depthsplat():
    for step, count, gaps in (
        (0, 2, (5, 10)),  # 6 // 2 times shorter
        (100, 2, (6, 16)),
        (101, 3, (10, 25)),
        (102, 4, (20, 50)),
        (104, 6, (20, 50)),
        (END, 6, (20, 50)),
    ):
        found = set()
        for seed in range(120):
            inputs, targets = drawn(Line(80), SIX, seed, step, farthest())
            assert list(inputs) == sorted({*inputs})
            gap = inputs[-1] - inputs[0]
            found.add(gap)
            # on a line the ends are the farthest points, so inputs are the ends of the gap
            assert len(inputs) == count
            assert len(targets) == 8
            assert len({*targets}) == min(8, gap + 1)
            assert inputs[0] <= min(targets) <= max(targets) <= inputs[-1]
        assert (min(found), max(found)) == gaps


BEND = along_x(torch.arange(21.0).clamp_min(17))
"""Cameras that wait at one place and go away at the end."""


def test_inputs_stand_where_cameras_move():
    sampler = farthest(max_gap=20)
    four = ViewsConfig(inputs=4, targets=8)
    assert drawn(Line(21, c2w=BEND), four, 0, END, sampler)[0][1:] == (18, 19, 20)


def test_batches_have_as_many_inputs_in_a_step_and_their_ranges_are_measured():
    gaps = "min_gap: 3, max_gap: 7, initial_min_gap: 3, initial_max_gap: 7"
    recipe = small(f"view_sampler={{type: datasets/farthest, {gaps}}}", "views.inputs=4")
    counts = [batch.inputs.images.shape[1] for batch in in_steps(recipe, 0, 8)]
    assert counts == [2, 2, 3, 3, 4, 4, 2, 2]
    assert trained_domain(stream_of(recipe), steps=600).ranges["views"] == (2, 4)


DEPTH = 10.0
SAMPLER = made(Overlapping)
SHUFFLED = torch.randperm(40, generator=torch.Generator().manual_seed(0))


POSES = arc((0.5 / DEPTH * (SHUFFLED - 20)).rad2deg(), DEPTH)
"""40 cameras .5 apart around what they look at, DEPTH away; files in an order of chance."""
HELD_OUT = Line(40, held_out=(0, 8, 16), c2w=POSES)


def draws(number, views=TWO, **options):
    sampler = made(Overlapping, **options)
    return [drawn(HELD_OUT, views, k, 0, sampler) for k in range(number)]


def steps(frames):
    """Places of frames on the arc."""
    return SHUFFLED[[*frames]].sort().values.tolist()


def apart(inputs, target):
    """Places from a target to the nearest input."""
    return (SHUFFLED[[*inputs]] - SHUFFLED[target]).abs().min()


def test_inputs_stand_beside_the_target_wherever_their_files_are():
    for count in (1, 2, 4):
        for inputs, targets in draws(60, ViewsConfig(inputs=count, targets=3)):
            assert list(inputs) == sorted({*inputs})
            assert len(inputs) == count
            assert len(targets) == 3
            assert {*inputs}.isdisjoint(targets)
            assert {*inputs, *targets}.isdisjoint(HELD_OUT.held_out)
            assert apart(inputs, targets[0]) <= 10  # .5 depths
    found = draws(60)
    assert found == draws(60), "a sample is a function of its seed"
    gaps = [np.ptp(steps(inputs)) for inputs, _ in found]
    assert min(gaps) <= 2
    assert max(gaps) >= 6
    assert len({inputs for inputs, _ in found}) > 40


def test_apart_moves_inputs_apart():
    near, far = (
        np.mean([np.ptp(steps(inputs)) for inputs, _ in draws(40, apart=(factor, factor))])
        for factor in (0.5, 2.0)
    )
    assert far > 2 * near


def test_every_held_out_photo_is_judged_with_inputs_beside_it():
    samples = samples_of(Lines(HELD_OUT), TWO, EvaluationConfig(), SAMPLER)
    assert [sample.target_frames for sample in samples] == [(0,), (8,), (16,)]
    for sample in samples:
        first, last = steps(sample.input_frames)
        assert first < SHUFFLED[sample.target_frames[0]] < last


def test_without_held_out_photos_four_of_all_are_judged():
    found = SAMPLER.windows(Line(40, c2w=POSES), TWO)
    assert [targets for _, targets in found] == [(0,), (13,), (26,), (39,)]
    for inputs, (target,) in found:
        assert target not in inputs
        assert apart(inputs, target) <= 5


def test_cameras_without_a_common_point_and_few_photos():
    """Their depth is swept; two photos are inputs, and the third is every target."""
    inputs, targets = drawn(Line(3, step=0.1), TWO, 0, 0, SAMPLER)
    assert len({*inputs}) == 2
    assert {*targets} == {0, 1, 2} - {*inputs}
    assert len(targets) == 3


def test_a_scene_that_moves_is_judged_in_its_order_and_not_drawn():
    scene = Line(40, held_out=(3,), c2w=POSES)
    scene.times = torch.arange(40).double()
    assert SAMPLER.windows(scene, TWO) == []
    must_refuse(r"moves, .* qgs/span", drawn, scene, TWO, 0, 0, SAMPLER)


def test_too_few_photos_are_refused():
    must_refuse("'line2' has 2 photos, but a sample needs 3", drawn, Line(2), TWO, 0, 0, SAMPLER)
    must_refuse(
        "has 1 photos beside 1 held-out ones, but a sample needs 2",
        SAMPLER.windows,
        Line(2, held_out=(1,)),
        TWO,
    )
