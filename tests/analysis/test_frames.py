import pytest

from qgs.analysis.reconstruction import choose_frames


def test_inputs_span_the_middle_and_novel_frames_lie_between():
    inputs, novel = choose_frames(69, 4, 21)
    assert (inputs[0], inputs[-1]) == (24, 44)
    assert len(inputs) == 4
    assert len(novel) == 6
    assert not set(inputs) & set(novel)
    assert all(min(inputs) < frame < max(inputs) for frame in novel)


def test_few_photos_are_spanned_whole():
    assert choose_frames(7, 2, 41)[0] == (0, 6)
    assert choose_frames(3, 3, 2) == ((0, 1, 2), ())
    assert choose_frames(5, 1, 3) == ((2,), ())


def test_given_frames_are_taken_as_they_are():
    assert choose_frames(20, 2, 10, [3, 9], [5, 12]) == ((3, 9), (5, 12))


def test_neighbouring_inputs_leave_nothing_between():
    assert choose_frames(20, 2, 10, [3, 4]) == ((3, 4), ())


@pytest.mark.parametrize(
    "arguments",
    [(5, 6, 9), (5, 2, 9, [1, 5]), (5, 2, 9, [-1, 2]), (5, 2, 9, [1, 1]), (5, 2, 9, [0, 3], [3])],
)
def test_frames_that_cannot_be_are_refused(arguments):
    with pytest.raises(ValueError, match=r"frames|too few"):
        choose_frames(*arguments)


def test_held_out_frames_are_compared_with_and_never_inputs():
    inputs, novel = choose_frames(20, 3, 10, held_out=(1, 6, 9, 12))
    assert not {1, 6, 9, 12} & set(inputs)
    assert set(novel) <= {6, 9, 12}
    assert novel
    assert choose_frames(20, 2, 10, [0, 4], held_out=(9,)) == ((0, 4), (1, 2, 3))
