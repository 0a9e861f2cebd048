"""Published weights in and out of checkpoints: bit-equal, or nothing is written."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from golden_weights import published
from safetensors.torch import load_file, save_file
from torch import Tensor

import qgs
from qgs.composer import resolve
from qgs.io.checkpoint import load_extra
from qgs.io.published import PublishedError
from qgs.io.transfer import export_weights, import_weights

MODELS = ("tokengs_a", "locus_full_a", "locus_no_radius_state_a", "locus_content_cross_attn_a")


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


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    assert a.keys() == b.keys()
    for name, tensor in a.items():
        assert tensor.dtype == b[name].dtype
        assert torch.equal(tensor, b[name]), name


@pytest.mark.parametrize("name", MODELS)
def test_import_export_import_is_bit_equal(
    imported: Callable[..., Path], tmp_path: Path, name: str
) -> None:
    checkpoint = imported(name)
    done = export_weights(checkpoint, tmp_path / "back.safetensors")
    back, original = load_file(tmp_path / "back.safetensors"), published(name)
    assert done.settings == ()
    assert set(done.unused) == original.keys() - back.keys()
    assert_same(back, {key: original[key] for key in back})
    recipe = resolve(checkpoint.with_suffix(".yaml"))
    import_weights(tmp_path / "back.safetensors", recipe, tmp_path / "again.safetensors")
    assert_same(load_file(checkpoint), load_file(tmp_path / "again.safetensors"))


def test_an_imported_checkpoint_is_like_any_other(imported: Callable[..., Path]) -> None:
    path = imported("locus_full_a")
    model = qgs.load(path)
    assert torch.equal(
        model.queries.get_parameter("center"), published("locus_full_a")["gs_anchor_xyz_raw"]
    )
    assert load_extra(path) == {"imported": "LocusGS weights locus_full_a.safetensors"}
    assert model.recipe == resolve(path.with_suffix(".yaml")).tree


def test_what_is_dropped_is_what_the_file_has(tmp_path: Path) -> None:
    weights = published("locus_full_a")
    unused = sorted(name for name in weights if "_norm." in name and "anchor" in name)
    save_file({k: v for k, v in weights.items() if k not in unused}, tmp_path / "w.safetensors")
    done = import_weights(tmp_path / "w.safetensors", None, tmp_path / "o.safetensors")
    assert len(unused) == 4
    assert len(done.unused) == 18 - 4
    assert set(done.unused) < weights.keys()
    assert done.count + len(done.unused) + len(unused) == len(weights)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_precisions_are_converted_only_on_demand(tmp_path: Path, dtype: torch.dtype) -> None:
    weights = {name: tensor.to(dtype) for name, tensor in published("tokengs_a").items()}
    path, out = tmp_path / "w.safetensors", tmp_path / "o.safetensors"
    save_file(weights, path)
    kind = str(dtype).removeprefix("torch.")
    with pytest.raises(PublishedError, match=f"{len(weights)} are {kind}.*--to-float32") as caught:
        import_weights(path, None, out)
    assert ("half precision" in str(caught.value)) is (dtype != torch.float64)
    assert list(tmp_path.iterdir()) == [path]
    done = import_weights(path, None, out, to_float32=True)
    assert any(kind in note for note in done.notes)
    features = load_file(out)["queries.features"]
    assert torch.equal(features, weights["gs_tokens"].float())


def test_parameters_that_share_memory_or_lie_in_strides(tmp_path: Path) -> None:
    weights = published("tokengs_a")
    tied = [name for name in weights if name.endswith("q_norm.weight")]
    weights |= dict.fromkeys(tied, weights[tied[0]])
    turned = weights["enc_dec_backbone.kv_proj.weight"].t().contiguous().t()
    assert not turned.is_contiguous()
    weights["enc_dec_backbone.kv_proj.weight"] = turned
    torch.save(weights, tmp_path / "w.pt")
    import_weights(tmp_path / "w.pt", None, tmp_path / "c.safetensors")
    export_weights(tmp_path / "c.safetensors", tmp_path / "back.safetensors")
    assert_same(load_file(tmp_path / "back.safetensors"), weights)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(
    imported: Callable[..., Path], tmp_path: Path, value: float
) -> None:
    broken = published("tokengs_a")["gs_tokens"].clone()
    broken[3, 5] = value
    with pytest.raises(ValueError, match="weights are not finite: gs_tokens; its training"):
        imported("tokengs_a", gs_tokens=broken)
    with pytest.raises(PublishedError, match="no real numbers: gs_tokens"):
        imported("tokengs_a", gs_tokens=broken.nan_to_num(0, 0).long())
    assert not (tmp_path / "made").exists()


OPTIONS_THAT_FIT = [
    ("model.width=32", "model.width: 64 (the recipe has 32)"),
    ("model.heads=8", "model.heads: 4 (the recipe has 8)"),
    ("model.queries.count=13", "model.queries.count: 12 (the recipe has 13)"),
    ("model.encoder.depth=3", "model.encoder.depth: 1 (the recipe has 3)"),
    ("model.encoder.patch_size=4", "model.encoder.patch_size: 8 (the recipe has 4)"),
    ("model.encoder.mlp_ratio=2", "model.encoder.mlp_ratio: 4.0 (the recipe has 2.0)"),
    ("model.decoder.depth=3", "model.decoder.depth: 2 (the recipe has 3)"),
    ("model.decoder.feed_forward.ratio=2", "model.decoder.feed_forward.ratio: 4.0"),
    ("model.head.gaussians_per_query=5", "model.head.gaussians_per_query: 4"),
    (
        "model.decoder.cross_attention={type: qgs/content}",
        "model.decoder.cross_attention.type: locus/ray_biased (the recipe has qgs/content)",
    ),
    (
        "model.decoder.self_attention={type: qgs/content}",
        "model.decoder.self_attention.type: locus/anchor_aware (the recipe has qgs/content)",
    ),
    ("model.decoder.refinement.radius=false", "model.decoder.refinement.radius: true"),
]


@pytest.mark.parametrize(("wrong", "told"), OPTIONS_THAT_FIT)
def test_a_recipe_that_does_not_fit_is_told_what_would(
    imported: Callable[..., Path], tmp_path: Path, wrong: str, told: str
) -> None:
    fitting = resolve(imported("locus_full_a").with_suffix(".yaml")).tree
    with pytest.raises(PublishedError) as caught:
        import_weights(
            tmp_path / "locus_full_a.safetensors",
            resolve(fitting, [wrong]),
            tmp_path / "x.safetensors",
        )
    message = str(caught.value)
    assert told in message
    options = message.split("names and shapes cannot tell")[0].split("that would fit")[1]
    assert options.count("the recipe has") == 1
    assert "bandwidth of the ray bias" in message
    assert "--recipe auto" in message
    assert not (tmp_path / "x.safetensors").exists()


@pytest.mark.parametrize(
    ("weights", "recipe", "words"),
    [
        ("tokengs_a", "locus_full_a", ["weights of TokenGS, the recipe composes LocusGS"]),
        ("locus_full_a", "tokengs_a", ["weights of LocusGS, the recipe composes TokenGS"]),
        (
            "locus_no_radius_state_a",
            "locus_full_a",
            ["model.queries.radius: false", "missing: gs_anchor_radius_raw", "5 missing"],
        ),
    ],
)
def test_weights_of_another_model(
    imported: Callable[..., Path], tmp_path: Path, weights: str, recipe: str, words: list[str]
) -> None:
    fitting = resolve(imported(recipe).with_suffix(".yaml"))
    with pytest.raises(PublishedError) as caught:
        imported(weights, fitting)
    assert all(part in str(caught.value) for part in words), caught.value
    assert not (tmp_path / "made" / f"{weights}.safetensors").exists()


def test_extra_and_missing_keys_stay_whatever_the_recipe(
    imported: Callable[..., Path], tmp_path: Path
) -> None:
    with pytest.raises(PublishedError) as caught:
        imported("tokengs_a", extra=torch.zeros(2), another=torch.zeros(()))
    message = str(caught.value)
    with pytest.raises(PublishedError, match="the file has 1 key that LocusGS has not"):
        imported("locus_full_a", stray=torch.zeros(1))
    assert "whatever the recipe says, the file has 2 keys that TokenGS has not" in message
    assert "unexpected: extra" in message
    assert "unexpected: another" in message
    assert "options that would fit" not in message
    assert not (tmp_path / "made").exists()


def test_names_of_no_published_model(tmp_path: Path) -> None:
    save_file({"some.layer": torch.zeros(3)}, tmp_path / "w.safetensors")
    with pytest.raises(PublishedError, match=r"no published model.*its names are some\.layer"):
        import_weights(tmp_path / "w.safetensors", None, tmp_path / "o.safetensors")


def test_nothing_is_overwritten(imported: Callable[..., Path], tmp_path: Path) -> None:
    checkpoint = imported("tokengs_a")
    before = checkpoint.read_bytes()
    with pytest.raises(FileExistsError, match="never overwritten"):
        imported("tokengs_a")
    checkpoint.unlink()
    with pytest.raises(FileExistsError, match=r"tokengs_a\.yaml"):
        imported("tokengs_a")
    checkpoint.write_bytes(before)
    with pytest.raises(FileExistsError):
        export_weights(checkpoint, tmp_path / "tokengs_a.safetensors")
    with pytest.raises(ValueError, match=r"name it \.safetensors"):
        export_weights(checkpoint, tmp_path / "w.pth")


def test_options_that_the_file_cannot_carry_are_told(
    imported: Callable[..., Path], tmp_path: Path
) -> None:
    fitting = resolve(imported("locus_full_a").with_suffix(".yaml")).tree
    changed = ["model.centers={type: qgs/free, z_offset: 0.0}", "model.head.scale_cap=0.2"]
    other = tmp_path / "other.safetensors"
    import_weights(tmp_path / "locus_full_a.safetensors", resolve(fitting, changed), other)
    settings = export_weights(other, tmp_path / "w.safetensors").settings
    assert "model.centers.type: qgs/free (LocusGS: locus/radius_scaled)" in settings
    assert "model.head.scale_cap: 0.2 (LocusGS: 0.075)" in settings


def test_models_without_a_published_form_are_not_exported(tmp_path: Path) -> None:
    tree = {"recipe": 1, "model": {"width": 16, "heads": 2, "head": {"norm": True}}}
    small = ["model.queries.count=4", "model.decoder.depth=1", "model.supervision.layers=[1]"]
    qgs.save(qgs.compose(tree, small), tmp_path / "c.safetensors")
    with pytest.raises(PublishedError, match=r"head\.norm\.weight: TokenGS has no such parameter"):
        export_weights(tmp_path / "c.safetensors", tmp_path / "w.safetensors")
    assert not (tmp_path / "w.safetensors").exists()


@pytest.mark.parametrize("name", ["bla.yaml", "bla.pth", "bla"])
def test_a_checkpoint_is_named_safetensors(tmp_path: Path, name: str) -> None:
    save_file(published("tokengs_a"), tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match=r"name it \.safetensors"):
        import_weights(tmp_path / "w.safetensors", None, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_no_checkpoint_stays_without_its_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, text: str) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("qgs.io.transfer.write_text", full)
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
    assert "# Given beside: views.inputs=3" in out.with_suffix(".yaml").read_text(encoding="utf-8")


def test_options_that_no_weight_shows_are_told_on_import(
    imported: Callable[..., Path], tmp_path: Path
) -> None:
    fitting = resolve(imported("tokengs_a").with_suffix(".yaml")).tree
    weights = tmp_path / "tokengs_a.safetensors"
    changed = ["model.head.quat_eps=1e-4", "model.queries.std=0.5", "seed=3"]
    done = import_weights(weights, resolve(fitting, changed), tmp_path / "o.safetensors")
    assert done.settings == ("model.head.quat_eps: 0.0001 (TokenGS: 1.0e-12)",)
    assert import_weights(weights, resolve(fitting), tmp_path / "p.safetensors").settings == ()


@pytest.mark.parametrize("prefix", ["model.", "ema_model.module.", "net._orig_mod."])
def test_one_prefix_of_all_names_is_taken_off(tmp_path: Path, prefix: str) -> None:
    weights = {prefix + name: tensor for name, tensor in published("locus_full_a").items()}
    save_file(weights, tmp_path / "w.safetensors")
    done = import_weights(tmp_path / "w.safetensors", None, tmp_path / "c.safetensors")
    assert done.notes == (f"took {prefix!r} off all {len(weights)} names",)
    assert done.count == 109


def test_the_recipe_that_fits_names_types_first_and_its_losses(
    imported: Callable[..., Path],
) -> None:
    text = imported("locus_full_a").with_suffix(".yaml").read_text(encoding="utf-8")
    assert "queries:\n    type: locus/anchored\n    count: 12\n" in text
    assert "#   losses: photometric, visibility, and anchor visibility" in text
