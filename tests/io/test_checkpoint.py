"""Checkpoints: the same model back, from a file that is opened once, or a reason."""

import json
import os
import pickle  # noqa: TID251
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import qgs
from qgs.composer import RecipeError, resolve
from qgs.composer.registry import available_plugins
from qgs.data.domain import KEY, Domain
from qgs.io import tensors as tensors_module
from qgs.io.checkpoint import (
    CheckpointFile,
    load_weights,
    save,
    unique_tensors,
    write_checkpoint,
)
from qgs.io.tensors import SEAL, CheckpointError, seal
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Views

RECIPES = Path(__file__).parents[2] / "recipes" / "tiny"
SMALL = ["model.width=16", "model.heads=2", "model.queries.count=8"]


@pytest.fixture(scope="module", params=["tokengs", "locus"])
def model(request: pytest.FixtureRequest) -> QueryGaussianModel:
    torch.manual_seed(0)
    model = qgs.compose(RECIPES / f"{request.param}.yaml", SMALL).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    return model


@pytest.fixture
def saved(model: QueryGaussianModel, tmp_path: Path) -> Path:
    path = tmp_path / "new" / "model.safetensors"
    qgs.save(model, path)
    return path


def metadata_of(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as file:
        return file.metadata()


def rewrite(path: Path, tensors: dict[str, torch.Tensor] | None = None, **changed: Any) -> None:
    """Write the file again with other tensors or metadata; None removes an entry."""
    metadata = {k: v for k, v in (metadata_of(path) | changed).items() if v is not None}
    own = {name: tensor.clone() for name, tensor in load_file(path).items()}
    save_file(own if tensors is None else tensors, path, metadata | {SEAL: seal(metadata)})


def test_a_loaded_model_predicts_the_same(model: QueryGaussianModel, saved: Path) -> None:
    loaded = qgs.load(saved)
    assert not loaded.training
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.2
    cameras = Cameras(c2w, torch.tensor([16.0, 16, 8, 8]).expand(1, 2, 4), (16, 16))
    views = Views(torch.rand(1, 2, 3, 16, 16), cameras)
    with torch.no_grad():
        a, b = (m(views).gaussians for m in (model, loaded))
    for name in ("means", "scales", "quats", "opacities", "colors"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_recipe_and_versions_travel_along(model: QueryGaussianModel, saved: Path) -> None:
    recipe = CheckpointFile(saved).recipe
    assert recipe.tree == model.recipe
    metadata = metadata_of(saved)
    assert metadata["qgs.version"] == qgs.__version__
    assert json.loads(metadata["qgs.plugins"]) == {n: v for n, (_, v) in recipe.releases.items()}
    distributions = json.loads(metadata["qgs.distributions"])
    assert distributions["qgs"] == "query-gaussians"
    assert distributions["rooms"] == "query-gaussians-rooms"


def test_only_plugins_that_are_used_are_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "photos.safetensors"
    save(qgs.compose(RECIPES / "photos.yaml", SMALL), path)
    without_rooms = {n: e for n, e in available_plugins().items() if n != "rooms"}
    for module in ("qgs.composer.registry", "qgs.io.checkpoint"):
        monkeypatch.setattr(f"{module}.available_plugins", lambda: without_rooms)
    assert set(CheckpointFile(path).recipe.releases) == {"qgs", "locus", "datasets"}
    assert qgs.load(path).queries.count == 8
    with pytest.raises(RecipeError, match="offers a plugin `rooms`"):
        qgs.compose(RECIPES / "photos.yaml", SMALL)


def test_a_model_without_a_step_is_saved_without_one(tmp_path: Path) -> None:
    """As an imported one: what follows the training is at its end, in every copy."""
    ramp = "model.renderer.dilation={schedule: linear, values: [10, 0.5], at: [1, 9]}"
    recipe = resolve(RECIPES / "tokengs.yaml", [*SMALL, ramp])
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    tensors = {k: x.detach() for k, x in unique_tensors(recipe.build_model()).items()}
    write_checkpoint(first, tensors, recipe.tree, recipe.releases, {})
    save(qgs.load(first), second)
    assert CheckpointFile(second).step is None
    assert qgs.load(second).renderer.config.model_dump()["dilation"] == 0.5
    save(recipe.build_model(), first, extra={"note": "ä = b"})
    assert CheckpointFile(first).step == 0
    assert CheckpointFile(first).extra == {"step": "0", "note": "ä = b"}


def test_shared_tensors_are_stored_once_and_stay_shared() -> None:
    module = torch.nn.ModuleDict({"a": torch.nn.Linear(3, 3), "b": torch.nn.Linear(3, 3)})
    module["b"].weight = module["a"].weight
    tensors = unique_tensors(module)
    assert sorted(tensors) == ["a.bias", "a.weight", "b.bias"]
    load_weights(module, {name: torch.ones_like(t) for name, t in tensors.items()}, "test")
    assert module["b"].weight is module["a"].weight
    assert (module["b"].weight == 1).all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(saved: Path, value: float) -> None:
    model = qgs.load(saved)
    with torch.no_grad():
        model.queries.features[0, 0] = value
    qgs.save(model, saved)
    with pytest.raises(ValueError, match=rf"{saved.name}: .*queries\.features"):
        qgs.load(saved)


def test_every_difference_is_listed_at_once(saved: Path) -> None:
    tensors = {name: tensor.clone() for name, tensor in load_file(saved).items()}
    del tensors["head.linear.bias"], tensors["encoder.norm.weight"]
    tensors["head.linear.weight"] = torch.zeros(2, 2)
    tensors["queries.features"] = tensors["queries.features"].view(torch.int32)
    tensors["stranger"] = torch.zeros(1)
    rewrite(saved, tensors, **{"qgs.digest": None})
    with pytest.raises(CheckpointError) as caught:
        qgs.load(saved)
    lines = [line.strip().partition(" in the file")[0] for line in str(caught.value).splitlines()]
    assert lines[1:6] == [
        "missing: encoder.norm.weight",
        "missing: head.linear.bias",
        "unexpected: stranger",
        "shape of head.linear.weight: (2, 2)",
        "type of queries.features: torch.int32",
    ]


@pytest.mark.parametrize("position", [-100, -5])
def test_a_flipped_bit_is_found(saved: Path, position: int) -> None:
    content = bytearray(saved.read_bytes())
    content[position] ^= 1
    saved.write_bytes(content)
    with pytest.raises(CheckpointError, match=f"^{saved} is damaged"):
        qgs.load(saved)


class Explosive:
    """Would leave a trace if it were unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_renamed_pickle_is_refused_unread(tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(pickle.dumps(Explosive(tmp_path / "trace"), protocol))
    with pytest.raises(CheckpointError, match="a Python pickle"):
        qgs.load(path)
    torch.save({"a": Explosive(tmp_path / "trace")}, path)
    with pytest.raises(CheckpointError, match="PyTorch"):
        qgs.load(path)
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("kept", [0, 4, 100, -10, None])
def test_a_truncated_file_or_text_is_refused(saved: Path, kept: int | None) -> None:
    saved.write_bytes(saved.read_bytes()[:kept] if kept is not None else b"recipe: 1\nmodel:\n")
    with pytest.raises(CheckpointError, match=str(saved)):
        qgs.load(saved)


def test_a_newer_format_is_refused(saved: Path) -> None:
    rewrite(saved, **{"qgs.format_version": "99"})
    with pytest.raises(CheckpointError, match=r"qgs\.format_version 99"):
        qgs.load(saved)


@pytest.mark.parametrize("option", ["width", "queries.count", "head.gaussians_per_query"])
def test_sizes_are_compared_before_anything_is_allocated(
    saved: Path, option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = json.loads(metadata_of(saved)["qgs.recipe"])
    *above, last = option.split(".")
    below = tree["model"]
    for key in above:
        below = below[key]
    below[last] = 65_536 if option == "width" else 10**9
    rewrite(saved, **{"qgs.recipe": json.dumps(tree)})
    monkeypatch.setattr(torch.nn.init, "normal_", None)
    monkeypatch.setattr(torch, "randn", lambda *shape: torch.empty(shape, device="meta"))
    with pytest.raises(CheckpointError, match="does not fit the model of its recipe"):
        qgs.load(saved)


TREE: Any = resolve(RECIPES / "tokengs.yaml").tree
PLAIN = {
    "qgs.recipe": json.dumps(TREE),
    "qgs.plugins": '{"qgs": "0.1.0"}',
    "qgs.distributions": "{}",
    "qgs.format_version": "2",
}


def test_a_changed_digit_in_any_metadata_is_refused(saved: Path) -> None:
    """Of the recipe, the step, the ranges, the seal itself and its name."""
    qgs.save(qgs.load(saved), saved, extra={"step": "7000", KEY: Domain({"depth": [1.0]}, 1).text})
    whole = saved.read_bytes()
    size = int.from_bytes(whole[:8], "little")
    header, metadata, refused = whole[8 : 8 + size], metadata_of(saved), 0
    rng = np.random.default_rng(0)
    for text in (json.dumps(text)[1:-1].encode() for entry in metadata.items() for text in entry):
        start = header.index(b'"' + text + b'"') + 1
        for at in start + rng.integers(0, len(text), 8):
            if not chr(header[at]).isalnum() or header[at - 1 : at] == b"\\":
                continue
            changed = bytearray(whole)
            changed[8 + at] = ord("4") if header[at] == ord("3") else ord("3")
            saved.write_bytes(changed)
            with pytest.raises(CheckpointError):
                CheckpointFile(saved)
            refused += 1
    assert refused > 60


def test_a_second_entry_of_one_name_changes_nothing_unseen(saved: Path) -> None:
    """The last one of a name is what a reader gets, and what the seal is compared with."""
    whole, tree = saved.read_bytes(), CheckpointFile(saved).recipe.tree
    size = int.from_bytes(whole[:8], "little")
    old = b'"qgs.format_version":"3"'
    assert whole.count(old) == 1
    for first, second in ((b"2", b"3"), (b"3", b"2")):
        pair = old.replace(b"3", first) + b"," + old.replace(b"3", second)
        header = whole[8 : 8 + size].rstrip().replace(old, pair)
        header += b" " * (-len(header) % 8)
        saved.write_bytes(len(header).to_bytes(8, "little") + header + whole[8 + size :])
        if second == b"3":
            assert CheckpointFile(saved).recipe.tree == tree
            continue
        with pytest.raises(CheckpointError, match="metadata"):
            CheckpointFile(saved)


def test_files_of_the_format_without_a_seal_are_read(saved: Path) -> None:
    own, metadata = load_file(saved), metadata_of(saved)
    del metadata[SEAL]
    save_file(own, saved, metadata)
    with pytest.raises(CheckpointError, match="lack"):
        CheckpointFile(saved)
    save_file(own, saved, metadata | {"qgs.format_version": "2"})
    assert CheckpointFile(saved).recipe.tree


def recipe_with(**changed: Any) -> dict[str, str]:
    return {"qgs.recipe": json.dumps({**TREE, **changed})}


@pytest.mark.parametrize(
    "changed",
    [
        pytest.param({"qgs.recipe": "null"}, id="null"),
        pytest.param({"qgs.recipe": '["optimizer"]'}, id="list"),
        pytest.param({"qgs.recipe": PLAIN["qgs.recipe"][:90]}, id="cut"),
        pytest.param({"qgs.recipe": '{"a":' * 5000}, id="deep"),
        pytest.param({"qgs.recipe": "{}"}, id="nothing"),
        pytest.param({"qgs.recipe": '{"training": [1], "plugins": 3}'}, id="wrong kinds"),
        pytest.param({"qgs.format_version": "x"}, id="format"),
        pytest.param({"qgs.plugins": "[1]", **recipe_with(plugins=["none"])}, id="plugins"),
        pytest.param(recipe_with(swap={"head": {"type": "qgs/free"}}), id="swap"),
        *(
            pytest.param(recipe_with(extends=name), id=f"extends {name}")
            for name in ("secret.yaml", "/dev/zero", ["secret.yaml"], None)
        ),
    ],
)
def test_forged_metadata_is_one_error_with_the_file_and_no_file_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, str]
) -> None:
    path = tmp_path / "model.safetensors"
    monkeypatch.chdir(tmp_path)
    Path("secret.yaml").write_text("the: secret\n")
    save_file({"x": torch.zeros(1)}, path, PLAIN)
    assert CheckpointFile(path).recipe.tree == TREE
    save_file({"x": torch.zeros(1)}, path, PLAIN | changed)
    with pytest.raises(CheckpointError) as caught:
        _ = CheckpointFile(path).recipe
    assert str(caught.value).startswith(str(path))
    assert "the: secret" not in str(caught.value)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("error", [PermissionError(13, "no"), OSError(5, "disk"), MemoryError()])
def test_errors_of_the_system_are_no_damage(
    saved: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr("qgs.io.tensors.safe_open", fails)
    with pytest.raises(type(error)) as raised:
        CheckpointFile(saved)
    assert raised.value is error


def test_loading_opens_the_file_once(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, counting = [], True
    whole = tensors_module.safe_open  # in Rust: seen by no audit hook

    def counted(path: Any, *arguments: Any) -> Any:
        opened.append(str(path))
        return whole(path, *arguments)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if counting and event == "open":
            opened.append(str(arguments[0]))

    monkeypatch.setattr(tensors_module, "safe_open", counted)
    sys.addaudithook(hook)
    qgs.load(saved)
    with CheckpointFile(saved) as file:
        _ = file.model(), file.recipe, file.tensors, file.step, file.domain, file.extra
    counting = False
    assert opened.count(str(saved)) == 2
