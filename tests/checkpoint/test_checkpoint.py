"""Checkpoints: the same model back, from a file that is opened once, or a reason."""

import json
import pickle  # noqa: TID251
from importlib.metadata import EntryPoints
from pathlib import Path

import pytest
import torch
from commands import SMALL
from safetensors.torch import save_file
from small_parts import Code, shaken
from tables import assert_equal, must_refuse, rows

import qgs
from qgs.checkpoint.model_file import CheckpointFile, save, unique_tensors, write_checkpoint
from qgs.checkpoint.tensors import SEAL, CheckpointError, TensorFile, copied, write_tensors
from qgs.domain import KEY, Domain
from qgs.recipe import RecipeError, resolve
from qgs.recipe.registry import available_plugins


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return shaken(qgs.compose("tiny/locus.yaml", SMALL).eval(), 0.01).float()


@pytest.fixture(scope="module")
def written(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "new/model.safetensors"
    qgs.save(model, path, extra={"step": "7000", KEY: Domain({"depth": [1.0]}, 1).text})
    return path.read_bytes()


@pytest.fixture
def saved(written, tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(written)
    return path


def metadata_of(path):
    return TensorFile(path).metadata


def tensors_of(path):
    return copied(TensorFile(path).read())


def rewrite(path, tensors=None, **changed):
    """Write the file again with other tensors or metadata, and checksums of these."""
    write_tensors(path, tensors or tensors_of(path), metadata_of(path) | changed)


def must_not_load(match, path, load=qgs.load):
    return str(must_refuse(match, load, path, kind=CheckpointError))


def test_a_loaded_model_is_the_saved_one(model, saved):
    loaded = qgs.load(saved)
    assert not loaded.training
    assert_equal(loaded.state_dict(), model.state_dict())
    recipe = CheckpointFile(saved).recipe
    metadata = metadata_of(saved)
    assert recipe.tree == loaded.recipe == model.recipe
    assert metadata["qgs.version"] == qgs.__version__
    assert json.loads(metadata["qgs.plugins"]) == {n: v for n, (_, v) in recipe.releases.items()}
    distributions = json.loads(metadata["qgs.distributions"])
    assert distributions["qgs"] == "query-gaussians"
    assert distributions["rooms"] == "query-gaussians-worlds"


def test_only_plugins_that_are_used_are_needed(tmp_path, monkeypatch):
    path = tmp_path / "photos.safetensors"
    photos = "tiny/photos.yaml"
    save(qgs.compose(photos, SMALL), path)
    without_rooms = EntryPoints(e for e in available_plugins() if e.name != "rooms")
    monkeypatch.setattr("qgs.recipe.registry.available_plugins", lambda: without_rooms)
    assert set(CheckpointFile(path).recipe.releases) == {"qgs", "locus", "datasets"}
    assert qgs.load(path).queries.count == 8
    must_refuse("that is fixed: choose none", qgs.load, path, gaussians=1)
    must_refuse("offers a plugin `rooms`", qgs.compose, photos, SMALL, kind=RecipeError)


def test_a_model_without_a_step_is_saved_without_one(tmp_path):
    """As an imported one: what follows the training is at its end, in every copy."""
    ramp = "model.renderer.dilation={schedule: linear, values: [10, 0.5], at: [1, 9]}"
    recipe = resolve("tiny/tokengs.yaml", [*SMALL, ramp])
    first = tmp_path / "first.safetensors"
    second = tmp_path / "second.safetensors"
    model = recipe.build_model()
    assert model.renderer.config.dilation == 10  # of the first step
    tensors = {k: x.detach() for k, x in unique_tensors(model).items()}
    write_checkpoint(first, tensors, recipe.tree, recipe.releases, {})
    save(qgs.load(first), second)
    assert CheckpointFile(second).step is None
    assert qgs.load(second).renderer.config.model_dump()["dilation"] == 0.5
    save(model, first, extra={"note": "ä = b"})
    assert CheckpointFile(first).step == 0
    assert CheckpointFile(first).extra == {"step": "0", "note": "ä = b"}


def test_weights_that_are_not_finite_are_refused(saved):
    tensors = tensors_of(saved)
    tensors["queries.features"][0, 0] = torch.nan
    tensors["head.linear.bias"][0] = torch.inf
    rewrite(saved, tensors)
    names = r"head\.linear\.bias.*queries\.features"
    must_refuse(rf"{saved.name}: .*{names}", qgs.load, saved)


def test_every_difference_is_listed_at_once(saved):
    tensors = tensors_of(saved)
    del tensors["head.linear.bias"], tensors["encoder.norm.weight"]
    tensors["head.linear.weight"] = torch.zeros(2, 2)
    tensors["queries.features"] = tensors["queries.features"].view(torch.int32)
    tensors["stranger"] = torch.zeros(1)
    rewrite(saved, tensors)
    told = must_not_load(".", saved)
    lines = [line.strip().partition(" in the file")[0] for line in told.splitlines()]
    assert lines[1:6] == [
        "missing: encoder.norm.weight",
        "missing: head.linear.bias",
        "unexpected: stranger",
        "shape of head.linear.weight: (2, 2)",
        "type of queries.features: torch.int32",
    ]


def test_damaged_files_are_refused_by_name(saved, written):
    for content in (*[written[:kept] for kept in (0, 4, 100, -10)], b"recipe: 1\nmodel:\n"):
        saved.write_bytes(content)
        must_not_load(str(saved), saved)


def test_a_renamed_pickle_is_refused_unread(saved):
    for protocol in (2, 4):
        saved.write_bytes(pickle.dumps(Code(), protocol))
        must_not_load("a Python pickle", saved)
    torch.save({"a": Code()}, saved)
    must_not_load("PyTorch", saved)


def test_sizes_are_compared_before_anything_is_allocated(saved, monkeypatch):
    monkeypatch.setattr(torch.nn.init, "normal_", None)
    monkeypatch.setattr(torch, "randn", lambda *shape: torch.empty(shape, device="meta"))
    recipe = json.loads(metadata_of(saved)["qgs.recipe"])
    for size in ("width=65536", "queries.count=1000000000", "head.gaussians_per_query=1000000000"):
        rewrite(saved, **{"qgs.recipe": json.dumps(resolve(recipe, [f"model.{size}"]).tree)})
        must_not_load("does not fit the model of its recipe", saved)


def test_a_changed_letter_in_any_metadata_is_refused(saved):
    """Of the recipe, the step, the ranges, the seal itself, and their names."""
    own = tensors_of(saved)
    metadata = metadata_of(saved)
    assert len(metadata) == 8
    for name, text in metadata.items():
        for changed in ({name: text[:-1] + "x"}, {name[:-1] + "x": text}):
            rest = dict(metadata)
            del rest[name]
            save_file(own, saved, rest | changed)
            must_not_load(".", saved, CheckpointFile)


VERSIONS = """
2 | format_version 2
99 | qgs.format_version 99
3 | lack
"""


def test_files_of_another_format_or_without_a_seal_are_refused(saved):
    metadata = metadata_of(saved)
    del metadata[SEAL]
    for version, fault in rows(VERSIONS):
        save_file(tensors_of(saved), saved, metadata | {"qgs.format_version": version})
        must_not_load(fault, saved, CheckpointFile)


def test_forged_metadata_is_one_error_with_the_file_and_no_file_is_followed(saved, written, here):
    Path("secret.yaml").write_text("the: secret\n")
    text = metadata_of(saved)["qgs.recipe"]
    recipes = ["null", '["optimizer"]', text[:90], '{"a":' * 5000, "{}"]
    recipes.append('{"training": [1], "plugins": 3}')
    names = ("secret.yaml", "/dev/zero", ["secret.yaml"], None)
    changes = [{"swap": {"head": {"type": "qgs/free"}}}, *({"extends": name} for name in names)]
    recipes += [json.dumps(json.loads(text) | change) for change in changes]
    unknown = json.dumps(json.loads(text) | {"plugins": ["none"]})
    for entries in (
        *({"qgs.recipe": recipe} for recipe in recipes),
        {"qgs.format_version": "x"},
        {"qgs.plugins": "[1]", "qgs.recipe": unknown},
    ):
        saved.write_bytes(written)
        rewrite(saved, **entries)
        told = must_not_load(f"^{saved}", saved, lambda path: CheckpointFile(path).recipe)
        assert "the: secret" not in told
        assert len(told) < 2000
