"""Views of photos in any order: which are inputs, how far apart, and what they are judged on."""

import numpy as np
import pytest
import torch
from line_scenes import Line, Lines, circle
from qgs_photos.datasets.overlapping import Overlapping

from qgs.contracts import EvaluationConfig, ViewsConfig
from qgs.evaluate.plan import EvaluationPlan
from qgs.recipe import RecipeError, resolve
from qgs.types import Cameras

DEPTH = 10.0
VIEWS = ViewsConfig(inputs=2, targets=3)
SAMPLER = Overlapping(Overlapping.Config())
SHUFFLED = torch.randperm(40, generator=torch.Generator().manual_seed(0))


class Arc(Line):
    """40 cameras .5 apart around what they look at, DEPTH away; files in an order of chance."""

    @property
    def cameras(self):
        c2w = circle(0.5 / DEPTH * (SHUFFLED - 20).double(), DEPTH)
        return Cameras(c2w, super().cameras.intrinsics, (8, 8))


def seeded(seed=0):
    return np.random.default_rng(seed)


def draws(count, views=VIEWS, **options):
    sampler = Overlapping(Overlapping.Config(**options))
    scene = Arc(40, held_out=(0, 8, 16))
    return [sampler.draw(scene, views, seeded(k), 0) for k in range(count)]


def steps(frames):
    """Places of frames on the arc."""
    return SHUFFLED[[*frames]].sort().values.tolist()


def apart(inputs, target):
    """Places from a target to the nearest input."""
    return (SHUFFLED[[*inputs]] - SHUFFLED[target]).abs().min()


def test_inputs_stand_beside_the_target_wherever_their_files_are():
    found = draws(60)
    for inputs, targets in found:
        assert list(inputs) == sorted({*inputs})
        assert len(targets) == 3
        assert not {*inputs} & {*targets, 0, 8, 16}
        assert not {*targets} & {0, 8, 16}
        assert apart(inputs, targets[0]) <= 10  # .5 depths
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
    scene = Arc(40, held_out=(0, 8, 16))
    plan = EvaluationPlan(Lines(scene), VIEWS, EvaluationConfig(), sampler=SAMPLER)
    samples = [*plan.samples()]
    assert [sample.target_frames for sample in samples] == [(0,), (8,), (16,)]
    for sample in samples:
        first, last = steps(sample.input_frames)
        assert first < SHUFFLED[sample.target_frames[0]] < last


def test_without_held_out_photos_four_of_all_are_judged():
    found = SAMPLER.windows(Arc(40), VIEWS)
    assert [targets for _, targets in found] == [(0,), (13,), (26,), (39,)]
    for inputs, (target,) in found:
        assert target not in inputs
        assert apart(inputs, target) <= 5


def test_any_number_of_inputs():
    for count in (1, 4):
        for inputs, targets in draws(20, ViewsConfig(inputs=count, targets=3)):
            assert len({*inputs}) == count
            assert apart(inputs, targets[0]) <= 10


def test_cameras_without_a_common_point_and_few_photos():
    """Their depth is swept; two photos are inputs, and the third is every target."""
    inputs, targets = SAMPLER.draw(Line(3, step=0.1), VIEWS, seeded(), 0)
    assert len({*inputs}) == 2
    assert {*targets} == {0, 1, 2} - {*inputs}
    assert len(targets) == 3


def test_a_scene_that_moves_is_judged_in_its_order_and_not_drawn():
    scene = Arc(40, held_out=(3,))
    scene.times = torch.arange(40).double()
    assert SAMPLER.windows(scene, VIEWS) == []
    with pytest.raises(ValueError, match=r"moves: .* qgs/span"):
        SAMPLER.draw(scene, VIEWS, seeded(), 0)


def test_too_few_photos_are_refused():
    with pytest.raises(ValueError, match="'line2' has 2 photos, and needs 3"):
        SAMPLER.draw(Line(2), VIEWS, seeded(), 0)
    with pytest.raises(ValueError, match="has 1 photos beside 1 held-out ones, and needs 2"):
        SAMPLER.windows(Line(2, held_out=(1,)), VIEWS)


def test_bounds_are_ordered():
    for apart in ("[2, 1]", "[0, 1]"):
        with pytest.raises(RecipeError, match="least"):
            resolve("finetune/photos.yaml", [f"view_sampler.apart={apart}"])
