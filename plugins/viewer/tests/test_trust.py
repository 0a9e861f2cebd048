"""The verdict on a model: what inputs see of scored views, and the rules of its words."""

import pytest
import torch
from qgs_viewer.trust import UNSEEN, WHOLE, WRONG, Part, means, scored_views, verdict
from walk import along_x, pinhole

from qgs.data.samples import Sample
from qgs.types import Rendering, Views

SIDE = 12


def cameras(*places):
    """They look along z, the view of each as wide as what it sees is far away."""
    return pinhole(along_x(places), size=(SIDE, SIDE))[None]


def test_a_pixel_is_seen_if_its_point_at_the_rendered_depth_lies_in_an_input():
    """A target a third of its view to the left of the input, and rows of little alpha."""
    grey = torch.full((1, 1, 3, SIDE, SIDE), 0.5)
    depth = torch.full((1, 1, 1, SIDE, SIDE), 2.0)
    alpha = torch.ones_like(depth)
    alpha[..., -4:, :] = 0.4
    inputs = Views(grey + 0.1, cameras(0.0))
    targets = Views(grey, cameras(-2 / 3))
    sample = Sample("test/room", inputs, targets, (3,), (7,), ())
    ((name, parts),) = scored_views(sample, Rendering(grey - 0.01, alpha, depth))
    assert name == "view 7 of test/room"
    found = {name: part.coverage for name, part in parts.items()}
    thirds = {"left": 0, "middle": 2 / 3, "right": 2 / 3, "top": 2 / 3, "bottom": 0}
    assert found == pytest.approx({WHOLE: 4 / 9, **thirds})
    assert parts["right"][1:] == pytest.approx((40, 20), abs=1e-3)
    assert parts["left"].doubt == UNSEEN


GOOD = Part(1.0, 26.0, 15.0)
BAD = Part(0.8, 14.0, 15.0)
DARK = Part(0.2, 30.0, 15.0)
NONE = Part(0.0, torch.nan, torch.nan)


def test_words_follow_the_rules():
    for whole, parts, said in (
        (GOOD, {}, "Sharp where the inputs look, at 100 % of the scored views (26.0 dB"),
        (Part(1.0, 24.9, 15.0), {}, "Soft"),
        (Part(1.0, 19.9, 15.0), {}, "Blurred"),
        (BAD, {}, "Wrong where the inputs look, at 80 %"),
        (BAD, {"left": DARK}, f"{UNSEEN}: the left third of a.jpg. Do not trust any part."),
        (NONE, {}, "Do not trust any part."),
        (GOOD, {"top": BAD}, f"{WRONG}: the top third of a.jpg. Do not trust the top third."),
        (GOOD, {"top": BAD, "left": DARK}, "Do not trust the top or the left third."),
    ):
        assert said in verdict([("a.jpg", {WHOLE: whole, **parts})])


def test_one_bad_view_of_three_is_named_and_no_more():
    good = ("b.jpg", {WHOLE: GOOD, "left": GOOD})
    views = [("a.jpg", {WHOLE: NONE, "left": DARK}), good, good]
    assert means(views) == pytest.approx((2 / 3, 26, 15))
    assert verdict(views).endswith(f"{UNSEEN}: the left third of a.jpg.")
