"""Checkpoints: the same model back, or a reason."""

import json
import os
import pickle  # noqa: TID251
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import qgs
from qgs.composer import RecipeError, resolve
from qgs.composer.registry import available_plugins
from qgs.contracts import CONTRACT_VERSION
from qgs.io.checkpoint import (
    CheckpointError,
    load_extra,
    load_recipe,
    load_step,
    load_weights,
    save,
    unique_tensors,
    write_checkpoint,
)
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Views

RECIPES = Path(__file__).parents[2] / "recipes" / "tiny"
SMALL = ["model.width=16", "model.heads=2", "model.queries.count=8"]


def locus_alone() -> QueryGaussianModel:
    tree = resolve(RECIPES / "locus.yaml", SMALL).tree
    return qgs.compose({**tree, "data": None, "plugins": ["locus"]})


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


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(saved: Path, value: float) -> None:
    model = qgs.load(saved)
    with torch.no_grad():
        model.queries.features[0, 0] = value
    qgs.save(model, saved)
    with pytest.raises(
        ValueError, match=r"weights are not finite: queries\.features; its training"
    ):
        qgs.load(saved)


def metadata_of(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as file:
        return file.metadata()


def rewrite(path: Path, tensors: dict[str, torch.Tensor] | None = None, **changed: Any) -> None:
    """Write the file again with other tensors or metadata; what is None there is left out."""
    metadata = {k: v for k, v in (metadata_of(path) | changed).items() if v is not None}
    with safe_open(path, "pt") as file:
        own = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(own if tensors is None else tensors, path, metadata)


def random_views() -> Views:
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(1, 2, 3, 16, 16, generator=generator)
    c2w = torch.eye(4).repeat(1, 2, 1, 1)
    c2w[0, 1, 0, 3] = 0.2
    return Views(images, Cameras(c2w, torch.tensor([16.0, 16, 8, 8]).expand(1, 2, 4), (16, 16)))


def test_a_loaded_model_predicts_the_same(model: QueryGaussianModel, saved: Path) -> None:
    loaded = qgs.load(saved)
    assert not loaded.training
    with torch.no_grad():
        a, b = (m(random_views()).gaussians for m in (model, loaded))
    for name in ("means", "scales", "quats", "opacities", "colors"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_recipe_and_versions_travel_along(model: QueryGaussianModel, saved: Path) -> None:
    assert load_recipe(saved).tree == model.recipe
    metadata = metadata_of(saved)
    assert metadata["qgs.version"] == qgs.__version__
    assert metadata["qgs.contract_version"] == str(CONTRACT_VERSION)
    assert json.loads(metadata["qgs.plugins"]) == dict(resolve(model.recipe).plugin_versions)


def test_the_distributions_of_plugins_travel_along(tmp_path: Path) -> None:
    save(locus_alone(), tmp_path / "a.safetensors")
    metadata = metadata_of(tmp_path / "a.safetensors")
    assert json.loads(metadata["qgs.distributions"]) == {
        "qgs": "query-gaussians",
        "locus": "query-gaussians-locus",
    }


@pytest.fixture
def old_locus(tmp_path: Path) -> Path:
    """A checkpoint of LocusGS that says it was made with query-gaussians-locus 0.0.7."""
    path = tmp_path / "old.safetensors"
    save(locus_alone(), path)
    versions = json.loads(metadata_of(path)["qgs.plugins"]) | {"locus": "0.0.7"}
    rewrite(path, **{"qgs.plugins": json.dumps(versions)})
    return path


@pytest.fixture
def orphan(old_locus: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That checkpoint, where no plugin is installed."""
    for module in ("qgs.composer.registry", "qgs.io.checkpoint"):
        monkeypatch.setattr(f"{module}.available_plugins", dict)
    return old_locus


@pytest.mark.parametrize(
    ("forgotten", "made_with"),
    [
        ((), "query-gaussians-locus {}"),
        (("qgs.distributions",), "the plugin `locus` {}"),
    ],
    ids=["now", "before distributions were kept"],
)
@pytest.mark.parametrize("read", [qgs.load, load_recipe])
def test_a_missing_plugin_is_told_by_file_and_distribution(
    read: Any, forgotten: tuple[str, ...], made_with: str, orphan: Path
) -> None:
    for key in forgotten:
        rewrite(orphan, **{key: None})
    with pytest.raises(CheckpointError) as caught:
        read(orphan)
    release = made_with.format("0.0.7")
    first, *rest = str(caught.value).splitlines()
    assert f"{orphan} was made with query-gaussians {qgs.__version__}, {release}, and" in first
    assert first.endswith(f"install {release}:")
    assert any("no installed distribution offers a plugin `locus`" in line for line in rest)


def test_only_plugins_that_are_used_are_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "photos.safetensors"
    save(qgs.compose(RECIPES / "photos.yaml", SMALL), path)
    without_rooms = {n: e for n, e in available_plugins().items() if n != "rooms"}
    for module in ("qgs.composer.registry", "qgs.io.checkpoint"):
        monkeypatch.setattr(f"{module}.available_plugins", lambda: without_rooms)
    assert set(load_recipe(path).plugin_versions) == {"qgs", "locus"}
    assert qgs.load(path).queries.count == 8
    with pytest.raises(RecipeError, match="offers a plugin `rooms`"):
        qgs.compose(RECIPES / "photos.yaml", SMALL)


def test_another_release_of_a_plugin_is_told(old_locus: Path) -> None:
    recipe = json.loads(metadata_of(old_locus)["qgs.recipe"])
    recipe["model"]["decoder"]["refinement"]["type"] = "locus/gone_since"
    rewrite(old_locus, **{"qgs.recipe": json.dumps(recipe)})
    with pytest.raises(
        CheckpointError, match=r"query-gaussians-locus 0\.0\.7, .*; install those releases:"
    ):
        qgs.load(old_locus)


def test_extra_metadata_comes_back(model: QueryGaussianModel, tmp_path: Path) -> None:
    save(model, tmp_path / "a.safetensors", extra={"step": "7", "note": "ä = b"})
    assert load_extra(tmp_path / "a.safetensors") == {"step": "7", "note": "ä = b"}


def test_a_model_without_a_step_is_saved_without_one(tmp_path: Path) -> None:
    """As an imported one: what follows the training is at its end, in every copy."""
    ramp = "model.renderer.dilation={schedule: linear, values: [10, 0.5], at: [1, 9]}"
    recipe = resolve(RECIPES / "tokengs.yaml", [*SMALL, ramp])
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    tensors = {k: x.detach() for k, x in unique_tensors(recipe.build_model()).items()}
    write_checkpoint(first, tensors, recipe.tree, {})
    save(qgs.load(first), second)
    assert load_step(second) is None
    assert qgs.load(second).renderer.config.model_dump()["dilation"] == 0.5
    save(recipe.build_model(), first)
    assert load_step(first) == 0


def test_shared_tensors_are_stored_once_and_stay_shared(tmp_path: Path) -> None:
    module = torch.nn.ModuleDict({"a": torch.nn.Linear(3, 3), "b": torch.nn.Linear(3, 3)})
    module["b"].weight = module["a"].weight
    tensors = unique_tensors(module)
    assert sorted(tensors) == ["a.bias", "a.weight", "b.bias"]
    load_weights(module, {name: torch.ones_like(t) for name, t in tensors.items()}, "test")
    assert module["b"].weight is module["a"].weight
    assert (module["b"].weight == 1).all()


def test_every_difference_is_listed_at_once(saved: Path) -> None:
    with safe_open(saved, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del tensors["head.linear.bias"], tensors["encoder.norm.weight"]
    tensors["head.linear.weight"] = torch.zeros(2, 2)
    tensors["stranger"] = torch.zeros(1)
    rewrite(saved, tensors)
    with pytest.raises(CheckpointError) as caught:
        qgs.load(saved)
    for words in (
        "4 differences",
        "missing: head.linear.bias",
        "missing: encoder.norm.weight",
        "unexpected: stranger",
        "shape of head.linear.weight: (2, 2) in the file",
    ):
        assert words in str(caught.value)


def test_a_hand_built_model_is_not_saved(model: QueryGaussianModel, tmp_path: Path) -> None:
    recipe, model.recipe = model.recipe, None
    try:
        with pytest.raises(ValueError, match=r"build it with qgs\.compose"):
            qgs.save(model, tmp_path / "a.safetensors")
    finally:
        model.recipe = recipe
    assert not any(tmp_path.iterdir())


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
    with pytest.raises(CheckpointError, match="not a whole safetensors file"):
        qgs.load(saved)


def test_a_safetensors_file_of_somebody_else_is_refused(tmp_path: Path) -> None:
    save_file({"a": torch.ones(1)}, tmp_path / "a.safetensors")
    with pytest.raises(CheckpointError, match="without a qgs recipe"):
        qgs.load(tmp_path / "a.safetensors")


@pytest.mark.parametrize("key", ["qgs.contract_version", "qgs.format_version"])
def test_a_newer_version_is_refused(saved: Path, key: str) -> None:
    rewrite(saved, **{key: "99", "qgs.version": "9.1"})
    with pytest.raises(CheckpointError, match=rf"qgs 9\.1 with {key} 99.*install the newer"):
        qgs.load(saved)


def test_no_file_at_all(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*a\.safetensors"):
        qgs.load(tmp_path / "a.safetensors")


def test_files_get_the_usual_permissions(saved: Path, tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    assert saved.stat().st_mode == (tmp_path / "plain").stat().st_mode
