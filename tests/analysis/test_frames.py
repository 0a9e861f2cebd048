from dataclasses import replace

import pytest
import torch
from photo_formats import noisy_photos, opened

from qgs.analysis.reconstruction import checked_window, choose_sample
from qgs.analysis.scenes import GivenScene, read_photos
from qgs.contracts import ViewsConfig
from qgs.data.samples import held_out_frames

VIEWS = ViewsConfig(inputs=4, gap=(3, 20))


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    return read_photos(noisy_photos(tmp_path_factory.mktemp("photos"), 9, step=0.1), size=(8, 8))


def moving(views, times, held_out=()):
    """The photos, taken at `times`."""
    scene = GivenScene(replace(views, times=torch.tensor([times])))
    scene.held_out = held_out
    return scene


def test_inputs_spread_over_times_and_novel_frames_are_of_one_time_between(views):
    scene = moving(views, [0.0, 1, 2, 3, 4, 4, 5, 6, 7], held_out=(3, 4, 5))
    sample, _ = choose_sample(scene, VIEWS, 2, None, None)
    assert sample.input_frames == (0, 8)
    assert sample.target_frames == (4, 5)
    few = VIEWS.model_copy(update={"gap": (3, 4)})
    near, _ = choose_sample(moving(views, [*map(float, range(9))]), few, 3, None, None)
    assert near.input_frames == (2, 4, 6)


def test_held_out_times_are_compared_with_and_never_inputs(views):
    scene = moving(views, [*map(float, range(9))], held_out=(3, 8))
    sample, _ = choose_sample(scene, VIEWS, 4, None, None)
    assert sample.target_frames == (3,)
    assert not {3, 8} & {*sample.input_frames}
    with pytest.raises(ValueError, match="7 times, too few"):
        choose_sample(scene, VIEWS, 8, None, None)


def test_given_frames_are_taken_as_they_are(views):
    assert checked_window(20, [3, 9], [5, 12]) == ((3, 9), (5, 12))
    sample, _ = choose_sample(GivenScene(views), VIEWS, None, [1, 3], [2])
    assert (sample.input_frames, sample.target_frames) == ((1, 3), (2,))


@pytest.mark.parametrize("window", [([1, 5], []), ([-1, 2], []), ([1, 1], []), ([0, 3], [3])])
def test_frames_that_cannot_be_are_refused(window):
    with pytest.raises(ValueError, match="frames"):
        checked_window(5, *window)


@pytest.mark.parametrize(
    ("count", "every", "frames"),
    [(20, 8, (4, 12)), (7, 8, (3,)), (3, 8, (1,)), (2, 8, ()), (7, 3, (1, 4)), (9, 0, ())],
)
def test_every_nth_photo_is_held_out_or_the_middle_one(count, every, frames, tmp_path):
    assert held_out_frames(count, every) == frames
    photos = opened(noisy_photos(tmp_path, count, step=0.1), (8, 8), holdout=every)
    assert tuple(photos.scenes("test")[0].held_out) == frames
