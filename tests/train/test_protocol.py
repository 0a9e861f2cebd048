"""Protocols: their hash follows what decides the numbers, and nothing else."""

import json
from functools import partial

import pytest
from tables import write_json
from training_runs import tiny

from qgs.evaluate.plan import read_index
from qgs.evaluate.protocol import protocol_of
from qgs.recipe import resolve

INDEX = json.loads('{"a": {"context": [0, 3], "target": [1, 2]}, "b": null}')
OTHERS = """
{"a": {"context": [3, 0], "target": [1, 2]}, "b": null}
{"a": {"context": [0, 3], "target": [1]}, "b": null}
{"a": {"context": [0, 3], "target": [1, 2]}, "b": {"context": [0], "target": [1]}}
{"a": {"context": [0, 3], "target": [1, 2]}}
"""


def indexed(file, *overrides):
    recipe = tiny("tokengs", f"evaluation.index={file}", *overrides)
    return protocol_of(recipe, read_index(str(file)))


def drawn(*overrides, scenes=("x",)):
    return protocol_of(tiny("tokengs", *overrides), None, scenes)


@pytest.fixture
def file(tmp_path):
    file = tmp_path / "published.json"
    write_json(file, INDEX)
    return file


def test_the_content_of_the_index_is_hashed_and_neither_its_place_nor_its_form(file, tmp_path):
    first = indexed(file)
    assert first.name == "published"
    assert str(tmp_path) not in first.canonical
    named = indexed(file, "evaluation.protocol=mine")
    assert named.name == "mine"
    assert named.sha256 == first.sha256
    copy = tmp_path / "renamed.json"
    copy.write_text(json.dumps(dict(reversed(INDEX.items())), indent=4))
    assert indexed(copy).sha256 == first.sha256
    hashes = {first.sha256}
    for other in OTHERS.strip().splitlines():
        file.write_text(other)
        hashes.add(indexed(file).sha256)
    assert len(hashes) == 5


NUMBERS = """
data.image_size=[64,32] data.fov=[60.0,70.0]
views.frame=mean_cam views.scale=distance views.scale_factor=0.5
metrics.ssim.covariance=sample metrics.dispersion=null evaluation.tuning_steps=50
model.renderer.background=[0.0,0.0,0.0] model.renderer.near=0.5
model.renderer.far=50.0 model.renderer.dilation=0.1
"""
NOTHING = """
training.steps=7 model.queries.count=48 data.cache_mb=1 views.mirror=0.25 seed=4
model.renderer.type=qgs/cpu
"""
DRAWING = "evaluation.seed=1 evaluation.samples=2 views.gap=[3,5] data.test_scenes=9"


def test_whatever_decides_the_numbers_is_hashed_and_nothing_else(file):
    numbers, drawing, nothing = (text.split() for text in (NUMBERS, DRAWING, NOTHING))

    def changing(protocol):
        plain = protocol().sha256
        return [o for o in numbers + drawing + nothing if protocol(o).sha256 != plain]

    assert changing(partial(indexed, file)) == numbers
    assert changing(drawn) == numbers + drawing
    assert drawn(scenes=("x", "y")).sha256 != drawn().sha256


def test_splits_count_only_where_no_index_names_the_frames(file):
    index = read_index(str(file))
    photos = tiny("tokengs").tree | {"plugins": ["datasets"]}
    for kind_and_split in (
        "qgs/photos data.holdout=4",
        "qgs/photos data.max_frames=9",
        "datasets/chunks data.holdout=4",
        "datasets/dl3dv data.holdout=4",
    ):
        kind, split = kind_and_split.split()
        tree = {**photos, "data": {"type": kind, "path": "x", "image_size": [16, 16]}}
        recipes = [resolve(tree), resolve(tree, [split])]
        assert len({protocol_of(recipe, index).sha256 for recipe in recipes}) == 1, kind
        assert len({protocol_of(recipe, None, ["x"]).sha256 for recipe in recipes}) == 2, kind


def test_a_renderer_that_follows_the_training_has_its_numbers_of_then():
    dilation = "{schedule: steps, values: [10, 0.3], at: [50]}"
    falling = tiny("tokengs", f"model.renderer.dilation={dilation}")
    assert protocol_of(falling).sha256 == protocol_of(tiny("tokengs")).sha256
    assert protocol_of(falling, step=0).content["renderer"]["dilation"] == 10
