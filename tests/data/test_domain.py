"""What views a model was trained on: measured, stored, and told of others."""

import json
import math
import re

import pytest
import torch
from line_scenes import DOWN, judged_samples
from photo_formats import cut
from tables import assert_near
from training_runs import resume, run, stream_of, tiny
from walk import along_x, pinhole

from qgs.checkpoint.model_file import CheckpointFile, load, save
from qgs.checkpoint.tensors import CheckpointError
from qgs.data import stream
from qgs.data.stream import trained_domain
from qgs.domain import KEY, Domain, verdict
from qgs.geometry.poses import look_at
from qgs.recipe import resolve


def recipe(*words):
    return tiny("tokengs", "data.scenes=4", "optimizer.warmup=0", *words)


def around(target, eyes, focal=16.0):
    """Cameras (1, V) of 32 x 32 pixels at `eyes` along x that look at (0, 0, target)."""
    places = torch.tensor([[x, 0.0, 0.0] for x in eyes])
    c2w = look_at(places, torch.tensor([0.0, 0.0, target]) - places, DOWN)
    return pinhole(c2w, (focal, focal, 16.0, 16.0), (32, 32))[None]


PAIR = around(2, (-0.5, 0.5))
PARALLEL = PAIR.replace(c2w=along_x([0.0, 1.0])[None])


def domain(*cameras):
    found = Domain()
    for both in cameras:
        found.see(both, both)
    return found


def test_what_is_measured():
    found = domain(PAIR).ranges
    assert found["views"] == (2, 2)
    assert_near(found["baseline"], (1, 1))
    assert_near(found["turn"], [2 * math.degrees(math.atan(0.25))] * 2, rtol=1e-3)
    assert_near(found["depth"], [math.sqrt(4.25)] * 2, rtol=1e-3)
    assert_near(found["fov"], (90, 90))
    assert found["side"] == (32, 32)


def test_axes_that_do_not_meet_before_the_cameras_look_infinitely_far():
    away = PAIR.replace(c2w=PAIR.c2w * torch.tensor([1, -1, -1, 1]))
    for cameras in (away, PARALLEL):
        assert domain(cameras).ranges["depth"] == (math.inf, math.inf)


def test_a_domain_is_read_as_it_was_written():
    found = domain(around(2, [0]))
    assert found.ranges["depth"] == (math.inf, math.inf)
    assert "baseline" not in found.ranges
    read = Domain.read(json.loads(found.text))
    assert read.ranges == found.ranges
    assert read.samples == 1


def test_a_few_pairs_of_parallel_axes_do_not_make_every_depth_one_that_was_trained():
    for few, largest in ((10, math.inf), (3, 2.062)):
        mixed = domain(*[PAIR] * (100 - few), *[PARALLEL] * few)
        assert_near(mixed.ranges["depth"], (2.062, largest))
    assert "look at is infinitely far" in str(mixed.differences(domain(PARALLEL)))


def test_a_file_without_image_sizes_has_those_of_its_recipe(tmp_path):
    file = tmp_path / "a.safetensors"
    older = '{"samples": 1, "ranges": {"fov": [50, 60]}}'
    save(recipe("training.image_sizes=[[16,24],[32,32]]").build_model(), file, extra={KEY: older})
    assert load(file).trained_on.ranges == {"fov": (50, 60), "side": (16, 32)}


def test_a_damaged_domain_is_one_error_with_the_file(tmp_path):
    file = tmp_path / "a.safetensors"
    model = recipe().build_model()
    for written in (
        '{"samples": 1',
        '{"samples": 1, "ranges": {"fov": 50}}',
        '{"samples": -1, "ranges": {"foo": [NaN, 1]}}',
        '{"samples": 1, "ranges": ' + "[" * 9000 + "]" * 9000 + "}",
    ):
        save(model, file, extra={KEY: written})
        with pytest.raises(CheckpointError, match=r"a\.safetensors"):
            _ = CheckpointFile(file).domain


def test_the_sentence():
    trained = domain(around(1, (-0.1, 0.1)), around(2, (-0.2, 0.2)))
    within = domain(around(1.5, (-0.15, 0.15)))
    assert not trained.differences(within)
    assert not trained.differences(domain(around(1.5, (-0.15, 0.15, 0))))
    wide = domain(around(1.5, (-1.5, 1.5, 0, 0.5), focal=4.0))
    outside = trained.differences(wide)
    assert [float(re.findall(r"[\d.]+", text)[0]) for text in outside] == [4, 3, 90, 152]
    assert all(text in verdict(trained, wide) for text in outside)
    assert "checkpoint does not record" in verdict(Domain(), within)


GROWING = "view_sampler.max_gap={schedule: linear, values: [4, 20], at: [0, 10]}"


def test_the_own_test_data_of_a_recipe_lie_inside(monkeypatch):
    monkeypatch.setattr(stream, "MEASURED", 128)
    for name, options in (("tokengs", ["training.steps=12", GROWING]), ("tokengs_bounded", [])):
        recipe = resolve(f"recipes/tiny/{name}.yaml", options)
        trained = trained_domain(stream_of(recipe), recipe.training.steps)
        test = Domain()
        for sample in judged_samples(recipe):
            test.see(sample.inputs.cameras, sample.targets.cameras)
        assert not trained.differences(test)


def test_a_scene_that_fails_is_left_out_of_the_ranges(monkeypatch):
    scene = recipe().build_data().scenes("train")[0]
    monkeypatch.setattr(type(scene), "cameras", None)
    assert trained_domain(stream_of(recipe()), 0).samples == 0


def test_checkpoints_tell_what_they_were_trained_on_also_where_one_was_cut(here):
    two = recipe("training.steps=2")
    expected = trained_domain(stream_of(two), 2).ranges
    file = run(recipe("training.steps=1")).folder.checkpoint
    assert CheckpointFile(file).domain.ranges == expected
    cut(file, 0.01)
    resume(two)
    found = CheckpointFile(file).domain
    assert found.ranges == expected
    assert found.samples == stream.MEASURED
