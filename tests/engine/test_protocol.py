"""Protocols: their hash follows what decides the numbers, and nothing else."""

import json
from pathlib import Path

import pytest
import yaml
from training_runs import Tiny

from qgs.composer import Recipe, resolve
from qgs.data.evaluation import read_index
from qgs.engine.protocol import Protocol, index_of, protocol_of

RECIPES = Path(__file__).parents[2] / "recipes" / "tiny"
INDEX = {"a": {"context": [0, 3], "target": [1, 2]}, "b": None}


def indexed(tiny: Tiny, file: Path, *overrides: str) -> Protocol:
    recipe = tiny("tokengs", f"evaluation.index={file}", *overrides)
    return protocol_of(recipe, index_of(recipe))


def drawn(tiny: Tiny, *overrides: str, scenes: tuple[str, ...] = ("x",)) -> str:
    return protocol_of(tiny("tokengs", *overrides), None, scenes).sha256


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "published.json"
    file.write_text(json.dumps(INDEX))
    return file


def test_neither_place_nor_form_of_the_index_matters(
    tiny: Tiny, file: Path, tmp_path: Path
) -> None:
    first = indexed(tiny, file)
    assert first.name == "published"
    copy = tmp_path / "elsewhere" / "renamed.json"
    copy.parent.mkdir()
    copy.write_text(json.dumps(dict(reversed(INDEX.items())), indent=4))
    assert indexed(tiny, copy).sha256 == first.sha256
    assert str(tmp_path) not in first.canonical
    named = indexed(tiny, file, "evaluation.protocol=mine")
    assert (named.name, named.sha256) == ("mine", first.sha256)


@pytest.mark.parametrize(
    "changed",
    [
        {"a": {"context": [3, 0], "target": [1, 2]}, "b": None},
        {"a": {"context": [0, 3], "target": [1]}, "b": None},
        {"a": {"context": [0, 3], "target": [1, 2]}},
        {"a": {"context": [0, 3], "target": [1, 2]}, "b": {"context": [0], "target": [1]}},
    ],
)
def test_the_content_of_the_index_is_hashed(tiny: Tiny, file: Path, changed: dict) -> None:
    first = indexed(tiny, file).sha256
    file.write_text(json.dumps(changed))
    assert indexed(tiny, file).sha256 != first


@pytest.mark.parametrize(
    ("counts_with_an_index", "counts_where_drawn", "overrides"),
    [
        (
            True,
            True,
            [
                "data.image_size=[64, 32]",
                "views.frame=mean_cam",
                "views.scale=distance",
                "views.scale_factor=0.5",
                "metrics.ssim.covariance=sample",
                "metrics.dispersion=null",
                "evaluation.tuning_steps=50",
                "data.fov=[60.0, 70.0]",
                "model.renderer.background=[0.0, 0.0, 0.0]",
                "model.renderer.near=0.5",
                "model.renderer.far=50.0",
                "model.renderer.dilation=0.1",
            ],
        ),
        (
            False,
            False,
            [
                "training.steps=7",
                "model.queries.count=48",
                "data.cache_mb=1",
                "views.mirror=0.25",
                "seed=4",
                "model.renderer.type=qgs/cpu",
            ],
        ),
        (
            False,
            True,
            ["evaluation.seed=1", "evaluation.samples=2", "views.gap=[3, 5]", "data.test_scenes=9"],
        ),
    ],
    ids=["numbers", "nothing", "drawing"],
)
def test_whatever_decides_the_numbers_is_hashed_and_nothing_else(
    tiny: Tiny,
    file: Path,
    counts_with_an_index: bool,
    counts_where_drawn: bool,
    overrides: list[str],
) -> None:
    plain, plain_drawn = indexed(tiny, file).sha256, drawn(tiny)
    for override in overrides:
        assert (indexed(tiny, file, override).sha256 != plain) == counts_with_an_index, override
        assert (drawn(tiny, override) != plain_drawn) == counts_where_drawn, override


def test_drawn_scenes_are_named_and_a_long_index_is_not(tiny: Tiny, file: Path) -> None:
    assert drawn(tiny, scenes=("x", "y")) != drawn(tiny, scenes=("x",))
    assert indexed(tiny, file).settings()["views"]["index"].keys() == {"scenes", "sha256"}


@pytest.mark.parametrize(
    ("kind", "override"),
    [
        ("qgs/photos", "data.holdout=4"),
        ("qgs/photos", "data.max_frames=9"),
        ("datasets/chunks", "data.holdout=4"),
        ("datasets/dl3dv", "data.holdout=4"),
    ],
)
def test_splits_count_only_where_no_index_names_the_frames(
    file: Path, kind: str, override: str
) -> None:
    def recipe(*more: str) -> Recipe:
        tree = yaml.safe_load((RECIPES / "tokengs.yaml").read_text())
        return resolve({**tree, "plugins": ["datasets"], "data": {"type": kind, "path": "x"}}, more)

    plain, split = recipe(), recipe(override)
    index = read_index(str(file))
    assert protocol_of(split, index).sha256 == protocol_of(plain, index).sha256
    assert protocol_of(split, None, ["x"]).sha256 != protocol_of(plain, None, ["x"]).sha256


def test_a_renderer_that_follows_the_training_has_its_numbers_of_then(tiny: Tiny) -> None:
    dilation = "{schedule: steps, values: [10, 0.3], at: [50]}"
    plain, falling = tiny("tokengs"), tiny("tokengs", f"model.renderer.dilation={dilation}")
    assert protocol_of(falling).sha256 == protocol_of(plain).sha256
    assert protocol_of(falling, step=0).content["renderer"]["dilation"] == 10
