"""Damaged or hostile metadata of checkpoints: one error, with the file, and no file followed."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

import qgs
from qgs.composer import resolve
from qgs.io.checkpoint import CheckpointError, load_recipe

RECIPE = Path(__file__).parents[2] / "recipes" / "tiny" / "tokengs.yaml"
TREE: Any = resolve(RECIPE).tree
PLAIN = {
    "qgs.recipe": json.dumps(TREE),
    "qgs.plugins": '{"qgs": "0.1.0"}',
    "qgs.distributions": "{}",
    "qgs.contract_version": "1",
    "qgs.format_version": "2",
}


def recipe_with(**changed: Any) -> dict[str, str]:
    return {"qgs.recipe": json.dumps({**TREE, **changed})}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return tmp_path / "model.safetensors"


def test_the_recipe_that_the_others_damage_is_read(checkpoint: Path) -> None:
    save_file({"x": torch.zeros(1)}, checkpoint, PLAIN)
    assert load_recipe(checkpoint).tree == TREE


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        pytest.param({"qgs.recipe": "null"}, "`qgs.recipe` .*holds null", id="null"),
        pytest.param({"qgs.recipe": '"optimizer"'}, "`qgs.recipe` .*holds str", id="text"),
        pytest.param({"qgs.recipe": '["optimizer"]'}, "`qgs.recipe` .*holds list", id="list"),
        pytest.param({"qgs.recipe": PLAIN["qgs.recipe"][:90]}, "JSONDecodeError", id="cut"),
        pytest.param({"qgs.recipe": "[" * 5000}, "nested too deep", id="deep lists"),
        pytest.param({"qgs.recipe": '{"a":' * 5000}, "nested too deep", id="deep"),
        pytest.param({"qgs.recipe": "{}"}, "`recipe` is missing", id="nothing"),
        pytest.param(
            {"qgs.recipe": '{"training": [1], "plugins": 3}'}, "is the number 3", id="wrong kinds"
        ),
        pytest.param({"qgs.recipe": f'{{"seed": {"9" * 6000}}}'}, "6000 digits", id="integer"),
        pytest.param({"qgs.format_version": "x"}, "`qgs.format_version`", id="format"),
        pytest.param({"qgs.contract_version": ""}, "`qgs.contract_version`", id="contract"),
        pytest.param(
            {"qgs.contract_version": "9" * 5000}, "install the newer", id="contract of 9s"
        ),
        pytest.param(
            {"qgs.plugins": "[1]", **recipe_with(plugins=["none"])}, "`qgs.plugins`", id="plugins"
        ),
        pytest.param(recipe_with(swap={"head": {"type": "qgs/free"}}), "has `swap`", id="swap"),
        pytest.param(recipe_with(seed="\ud800"), "surrogate", id="surrogate"),
        pytest.param(recipe_with(seed=[1] * 30_000), "more than 20,000 values", id="values"),
    ],
)
def test_damaged_metadata_is_one_error_with_the_file(
    checkpoint: Path, changed: dict[str, str], message: str
) -> None:
    save_file({"x": torch.zeros(1)}, checkpoint, PLAIN | changed)
    with pytest.raises(CheckpointError, match=message) as caught:
        qgs.load(checkpoint)
    assert str(caught.value).startswith(str(checkpoint))
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("name", ["secret.yaml", "/dev/zero", ["secret.yaml"], None])
def test_no_file_is_followed_from_a_checkpoint(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch, name: Any
) -> None:
    monkeypatch.chdir(checkpoint.parent)
    Path("secret.yaml").write_text("the: secret\n")
    save_file({"x": torch.zeros(1)}, checkpoint, PLAIN | recipe_with(extends=name))
    with pytest.raises(CheckpointError, match="the recipe in it has `extends`") as caught:
        qgs.load(checkpoint)
    assert "the: secret" not in str(caught.value)
