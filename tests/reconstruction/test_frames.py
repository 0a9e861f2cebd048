"""Which photos are inputs, which are compared with, and which are held out."""

import pytest
import torch
import yaml
from photo_formats import noisy_photos
from tables import must_refuse
from walk import Walk

from qgs.contracts import ViewsConfig
from qgs.domain import Domain
from qgs.reconstruction.reconstruct import checked_window, choose_frames
from qgs.reconstruction.scenes import GivenScene, read_photos


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return read_photos(noisy_photos(tmp_path_factory.mktemp("photos"), 9), size=(8, 8))


def chosen(photos, inputs, times=range(9), held_out=(), gap=(3, 20)):
    """Input and compared frames of photos taken at `times`."""
    scene = GivenScene(photos.replace(times=torch.tensor([[*times]])))
    scene.held_out = held_out
    return choose_frames(scene, ViewsConfig(gap=gap), inputs, None, None, Domain())


def test_inputs_spread_over_times_and_novel_frames_are_of_one_time_between(photos):
    assert chosen(photos, 2, (0, 1, 2, 3, 4, 4, 5, 6, 7), held_out=(3, 4, 5)) == ((0, 8), (4, 5))
    assert chosen(photos, 3, gap=(3, 5))[0] == (1, 4, 7)


def test_held_out_times_are_compared_with_and_never_inputs(photos):
    inputs, compared = chosen(photos, 4, held_out=(3, 8))
    assert compared == (3,)
    assert not {3, 8} & {*inputs}
    must_refuse("7 different times, too few", chosen, photos, 8, held_out=(3, 8))


def test_frames_that_are_given_are_taken_as_they_are_or_refused(photos):
    given = (None, [1, 3], [2], Domain())
    assert choose_frames(GivenScene(photos), ViewsConfig(), *given) == ((1, 3), (2,))
    for compared, *frames in ((0, 1, 5), (0, -1, 2), (0, 1, 1), (3, 0, 3)):
        must_refuse("frames", checked_window, 5, frames, [compared])


def test_a_photo_between_two_inputs_is_an_input_unless_two_are_asked_for():
    walk = Walk()
    ranges = "{baseline: [1.8, 1.9], depth: [3.0, 3.0], turn: [30.0, 40.0]}"
    wide = Domain(yaml.safe_load(ranges), 4)
    for inputs, walk.held_out, compare, expected in (
        (None, (2,), None, (0, 1, 3)),
        (2, (2,), None, (0, 3)),
        (None, (), (0,), (1, 2, 4)),
    ):
        found, _ = choose_frames(walk, ViewsConfig(inputs=2), inputs, None, compare, wide)
        assert found == expected
