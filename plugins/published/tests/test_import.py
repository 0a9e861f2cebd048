"""Published weights become checkpoints: every tensor accounted for, or nothing is written."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from commands import run_qgs
from published.files import read_golden
from qgs_published.importing import import_weights
from qgs_published.layouts import PublishedError, fitting_recipe, names_of
from qgs_published.tokengs import TOKENGS
from qgs_tokengs2026.weights import TOKENGS_2026_6
from safetensors.torch import load_file, save, save_file
from torch import Tensor

import qgs
from qgs.composer import resolve
from qgs.composer.recipe import differing_predictions
from qgs.io.checkpoint import CheckpointFile
from qgs.io.tensors import shapes_of

ROOT = Path(__file__).parents[3]
RECIPES = ROOT / "recipes"


def published(name: str) -> dict[str, Tensor]:
    """The state dict in a golden file, such as "locus_full_a"; a new mapping each time."""
    return read_golden(ROOT / f"tests/golden/{name}.safetensors").weights()


LOCUS = published("locus_full_a")
GOLDEN = ["tokengs_a", "tokengs_latent_a", "tokengs_multiscale_a", "tokengs_dynamic_a",
          "locus_full_a", "locus_no_radius_state_a", "locus_content_cross_attn_a"]  # fmt: skip


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., Path]:
    """`imported("tokengs_a", recipe=None)`: the checkpoint that its weights make."""

    def make(name: str, recipe: Any = None, **changed: Tensor) -> Path:
        weights = tmp_path / f"{name}.safetensors"
        save_file(published(name) | changed, weights)
        out = tmp_path / "made" / f"{name}.safetensors"
        import_weights(weights, recipe, out)
        return out

    return make


def published_shapes(recipe: Any) -> dict[str, tuple[int, ...]]:
    names = names_of(recipe)
    return {theirs: names.shapes[ours] for ours, theirs in names.published.items()}


@pytest.mark.parametrize("name", GOLDEN)
def test_every_tensor_arrives_bit_equal_or_is_known_as_unused(
    imported: Callable[..., Path], name: str
) -> None:
    given, ours = published(name), load_file(imported(name))
    recipe = resolve(fitting_recipe(shapes_of(given), name)[1])
    names = names_of(recipe)
    assert ours.keys() == names.published.keys()
    assert given.keys() == {*names.published.values(), *names.unused}
    assert all(torch.equal(ours[key], given[theirs]) for key, theirs in names.published.items())


def test_an_imported_checkpoint_is_like_any_other(imported: Callable[..., Path]) -> None:
    path = imported("locus_full_a")
    model = qgs.load(path)
    assert torch.equal(model.queries.get_parameter("center"), LOCUS["gs_anchor_xyz_raw"])
    assert CheckpointFile(path).extra == {"imported": "LocusGS weights locus_full_a.safetensors"}
    text = path.with_suffix(".yaml").read_text(encoding="utf-8")
    assert model.recipe == resolve(path.with_suffix(".yaml")).tree
    assert "queries:\n    type: locus/anchored\n    count: 12\n" in text
    assert "#   losses: photometric, visibility, and anchor visibility" in text


LATENT_PRESETS = [f"latent_{n}views_{loss}" for n in (2, 4, 6) for loss in ("ssim", "lpips")]


@pytest.mark.parametrize("preset", [*LATENT_PRESETS, "dynamic"])
@pytest.mark.parametrize(
    "sizes",
    [
        {},
        {"width": 48, "heads": 3, "queries.count": 5, "encoder.latents": 7, "encoder.depth": 6,
         "encoder.blocks": [2, 4, 6], "encoder.latent_depth": 2, "encoder.patch_size": 4},
    ],
    ids=["published", "reduced"],
)  # fmt: skip
def test_a_latent_checkpoint_gives_the_recipe_of_its_preset(
    preset: str, sizes: dict[str, Any]
) -> None:
    if sizes and preset == "dynamic":
        sizes = {**sizes, "queries.dynamic": 2, "queries.patch_size": 4}
    overrides = [f"model.{option}={value}" for option, value in sizes.items()]
    recipe = resolve(RECIPES / f"tokengs/{preset}.yaml", overrides)
    theirs = published_shapes(recipe)
    assert theirs["enc_dec_backbone.latents"][0] == sizes.get("encoder.latents", 4096)
    layout, tree = fitting_recipe(theirs, "file")
    assert layout is TOKENGS_2026_6
    read = resolve(tree)
    models = ({"model": one.tree["model"]} for one in (recipe, read))
    assert differing_predictions(*models) == {}
    assert read.views.frame == recipe.views.frame == "mean_cam"
    assert read.views.scale_factor == recipe.views.scale_factor
    assert read.evaluation.tuning == "latents"


@pytest.mark.parametrize("recipe", sorted(RECIPES.glob("ablations/*.yaml")), ids=lambda p: p.stem)
def test_every_ablation_has_a_published_name_for_each_parameter(recipe: Path) -> None:
    names = names_of(resolve(recipe))
    assert not names.unnamed
    assert names.published.keys() == names.shapes.keys()
    assert not set(names.unused) & set(names.published.values())


def test_every_difference_is_listed_at_once() -> None:
    weights = published("tokengs_a")
    names = names_of(resolve(TOKENGS.read(shapes_of(weights))))
    del weights["gs_tokens"]
    weights["activation_head.deconv.bias"] = torch.zeros(3)
    weights |= {"stranger": torch.zeros(1), "gs_anchor_xyz_raw": torch.zeros(1)}
    with pytest.raises(PublishedError) as caught:
        names.from_published(weights)
    assert [line.strip() for line in str(caught.value).splitlines()[1:]] == [
        "missing: gs_tokens",
        "unexpected: stranger",
        "unexpected: gs_anchor_xyz_raw",
        "shape of activation_head.deconv.bias: (3,) in the file, (56,) in the recipe",
    ]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_precisions_are_converted_only_on_demand(tmp_path: Path, dtype: torch.dtype) -> None:
    weights = {name: tensor.to(dtype) for name, tensor in published("tokengs_a").items()}
    path, out = tmp_path / "w.safetensors", tmp_path / "o.safetensors"
    save_file(weights, path)
    kind = str(dtype).removeprefix("torch.")
    with pytest.raises(PublishedError, match=f"{len(weights)} are {kind}"):
        import_weights(path, None, out)
    assert list(tmp_path.iterdir()) == [path]
    done = import_weights(path, None, out, to_float32=True)
    assert any(kind in note for note in done.notes)
    assert torch.equal(load_file(out)["queries.features"], weights["gs_tokens"].float())


def test_parameters_that_share_memory_or_lie_in_strides(tmp_path: Path) -> None:
    weights = published("tokengs_a")
    tied = [name for name in weights if name.endswith("q_norm.weight")]
    weights |= dict.fromkeys(tied, weights[tied[0]])
    turned = weights["enc_dec_backbone.kv_proj.weight"].t().contiguous().t()
    assert not turned.is_contiguous()
    weights["enc_dec_backbone.kv_proj.weight"] = turned
    torch.save(weights, tmp_path / "w.pt")
    done = import_weights(tmp_path / "w.pt", None, tmp_path / "c.safetensors")
    ours = load_file(tmp_path / "c.safetensors")
    for name, theirs in names_of(done.recipe).published.items():
        assert torch.equal(ours[name], weights[theirs]), name


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(
    imported: Callable[..., Path], tmp_path: Path, value: float
) -> None:
    broken = published("tokengs_a")["gs_tokens"].clone()
    broken[3, 5] = value
    with pytest.raises(ValueError, match="gs_tokens"):
        imported("tokengs_a", gs_tokens=broken)
    with pytest.raises(PublishedError, match="gs_tokens"):
        imported("tokengs_a", gs_tokens=broken.nan_to_num(0, 0).long())
    assert not (tmp_path / "made").exists()


def test_nothing_is_overwritten(imported: Callable[..., Path]) -> None:
    checkpoint = imported("tokengs_a")
    with pytest.raises(FileExistsError, match=r"tokengs_a\.safetensors"):
        imported("tokengs_a")
    checkpoint.unlink()
    with pytest.raises(FileExistsError, match=r"tokengs_a\.yaml"):
        imported("tokengs_a")


def test_no_checkpoint_stays_without_its_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, text: str) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("qgs_published.importing.write_text", full)
    save_file(published("tokengs_a"), tmp_path / "w.safetensors")
    with pytest.raises(OSError, match="no space left"):
        import_weights(tmp_path / "w.safetensors", None, tmp_path / "c.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["w.safetensors"]


def test_the_recipe_that_fits_takes_overrides(tmp_path: Path) -> None:
    save_file(published("tokengs_a"), tmp_path / "w.safetensors")
    out = tmp_path / "c.safetensors"
    options = ["data={type: qgs/photos, path: photos, image_size: [16, 24]}", "views.inputs=3"]
    done = import_weights(tmp_path / "w.safetensors", None, out, overrides=options)
    written = resolve(out.with_suffix(".yaml"))
    assert written.tree == done.recipe.tree == qgs.load(out).recipe
    assert (written.views.inputs, written.tree["data"]["image_size"]) == (3, [16, 24])


@pytest.mark.parametrize("prefix", ["model.", "module.", "ema_model.module.", "net._orig_mod."])
def test_one_prefix_of_all_names_is_removed(tmp_path: Path, prefix: str) -> None:
    weights = {prefix + name: tensor for name, tensor in LOCUS.items()}
    save_file(weights, tmp_path / "w.safetensors")
    done = import_weights(tmp_path / "w.safetensors", None, tmp_path / "c.safetensors")
    assert prefix in done.notes[0]
    assert done.count == 109


def test_the_command_lists_every_tensor_and_setting(tmp_path: Path) -> None:
    weights, out = tmp_path / "locus.safetensors", tmp_path / "c.safetensors"
    save_file(LOCUS, weights)
    option = "model.head.scale_cap=0.1"
    told = run_qgs("import", weights, "--recipe", "auto", "--out", out, "--set", option).output
    assert "LocusGS (leo-frank/LocusGS): 109 tensors used" in told
    assert "  enc_dec_backbone.decoder_blocks.1.gs_cross_attn.tau_sample\n" in told
    assert "model.head.scale_cap: 0.1 (LocusGS: 0.075)" in told
    again = tmp_path / "again.safetensors"
    run_qgs("import", weights, "--recipe", out.with_suffix(".yaml"), "--out", again)
    assert qgs.load(again).recipe == qgs.load(out).recipe
    half = tmp_path / "half.safetensors"
    half.write_bytes(save({name: tensor.half() for name, tensor in LOCUS.items()}))
    before = sorted(tmp_path.iterdir())
    words = ("import", half, "--recipe", "auto", "--out", tmp_path / "new" / "x.safetensors")
    assert isinstance(run_qgs(*words).exception, PublishedError)
    assert sorted(tmp_path.iterdir()) == before
    assert "converted to float32: 109 of 109 are float16" in run_qgs(*words, "--to-float32").output
