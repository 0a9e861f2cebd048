"""The search for the scale of photos: which photos it judges, and which factors it tries."""

import torch
from tables import assert_near, must_refuse
from training_runs import run, tiny
from walk import Walk

import qgs
from qgs.contracts import ViewsConfig
from qgs.domain import Domain
from qgs.reconstruction import scale


def test_settings_search_where_nothing_is_known():
    views = ViewsConfig(scale="constant")
    for expected, given in (
        ("search", (views, False)),
        ("constant", (views, True)),
        ("constant", (views, False, ["views.scale_factor=2"])),
        ("distance", (ViewsConfig(scale="distance"), False)),
    ):
        assert scale.photo_settings(*given).scale == expected


def test_further_photos_lie_between_and_are_not_compared_with():
    walk = Walk()
    for walk.held_out, compared, further in (
        ((), (2,), (1, 3)),
        ((1, 2), (), (3, 5)),
        ((1, 2), (3, 5), ()),
    ):
        assert scale.further_photos(walk, (0, 4), compared) == further


def searched(*frames):
    """What is found for these inputs and compared frames, by an untrained model."""
    model = qgs.compose("tiny/tokengs.yaml", ["model.queries.count=12"]).eval()
    return scale.find_scale(model, Walk(), *frames, ViewsConfig(inputs=2, scale="search"))


def test_without_further_photos_an_input_is_judged_or_inputs_alone():
    assert searched((0, 2, 4), (1, 3, 5)).further == (2,)
    two = searched((1, 4), (0, 2, 3, 5))
    assert two.further == ()
    assert two.poor


def test_the_range_follows_the_unit_and_the_training():
    baseline = float((Walk.cameras.c2w[1] - Walk.cameras.c2w[4])[:3, 3].norm())
    trained = Domain({"baseline": [0.1, 0.4]}, 4)
    far = Domain({"baseline": [0.1, 0.4], "depth": [5.0, 6.0]}, 4)
    wide = (0.1 / 2 / baseline, 0.4 * 4 / baseline)
    for known, depth, expected in (
        (trained, 0.0, wide),
        (trained, 3.0, (0.4 / 3, 2 / 3)),
        (trained, 1.0, (0.4, wide[1])),
        (trained, 100.0, wide),  # the training has another unit
        (far, 3.0, wide),
    ):
        assert_near(scale.search_range(known, Walk(), (1, 4), depth), expected, rtol=1e-5)
    turning = Domain({"baseline": [0.0, 0.0]}, 4)
    assert scale.search_range(turning, Walk(), (1, 4), 3.0) == (1.0, 1.0)
    still = Walk()
    still.cameras = Walk.cameras[[2, 2]]
    assert scale.search_range(Domain(), still, (0, 1), 0.0) == (1.0, 1.0)


def test_depth_maps_keep_a_search_on_inputs_alone_near_their_depth(monkeypatch):
    monkeypatch.setattr(Walk, "depths", lambda self, frames: torch.tensor([0.0, 2.0, 2.0]))
    found = searched((1, 4), (0, 2, 3, 5))
    assert found.depth == 2
    assert "inputs" not in found.poor.split(";")[0]
    factors = [factor for factor, _ in found.tried]
    assert 0.3 * 0.4 / 2 < min(factors) <= max(factors) < 2 / 2 * 1.7


def test_training_and_evaluation_refuse_a_search(here):
    must_refuse(r"views\.scale: search", run, tiny("tokengs", "views.scale=search"))
