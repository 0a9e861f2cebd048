"""Published weights become checkpoints: every tensor accounted for, or nothing is written."""

from unittest.mock import Mock

import torch
from commands import run_qgs
from fuzzing.cases import RECIPES
from published.files import read_golden
from qgs_research.published.importing import import_weights
from qgs_research.published.layouts import PublishedError, fitting_recipe, names_of
from qgs_research.published.tokengs import TOKENGS, TOKENGS_2026_6
from safetensors.torch import load_file, save_file
from tables import assert_equal, must_refuse, names_in

import qgs
from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.tensors import shapes_of
from qgs.recipe import resolve
from qgs.recipe.recipe import differing_predictions


def published(name):
    """The state dict in a golden file."""
    return read_golden(RECIPES.parent / f"tests/golden/{name}.safetensors").weights()


TOKENGS_A = published("tokengs_a")
LOCUS = published("locus_full_a")


def imported(folder, weights, **options):
    """What was made of a file with these weights, as folder/made.safetensors."""
    folder.mkdir(exist_ok=True)
    save_file(weights, folder / "w.safetensors")
    return import_weights(folder / "w.safetensors", None, folder / "made.safetensors", **options)


def arrived(file, weights):
    """Names of the layout of a checkpoint that holds these weights, bit by bit."""
    known = names_of(resolve(file.with_suffix(".yaml")))
    assert_equal(load_file(file), {key: weights[theirs] for key, theirs in known.published.items()})
    return known


FILES = """
tokengs_a tokengs_latent_a tokengs_multiscale_a tokengs_dynamic_a
locus_full_a locus_no_radius_state_a locus_content_cross_attn_a
"""


def test_every_tensor_arrives_bit_equal_or_is_known_as_unused(tmp_path):
    for name in FILES.split():
        folder = tmp_path / name
        given = published(name)
        imported(folder, given)
        known = arrived(folder / "made.safetensors", given)
        assert given.keys() == {*known.published.values(), *known.unused}


def test_an_imported_checkpoint_is_like_any_other(tmp_path):
    imported(tmp_path, LOCUS)
    path = tmp_path / "made.safetensors"
    model = qgs.load(path)
    assert_equal(model.queries.get_parameter("center"), LOCUS["gs_anchor_xyz_raw"])
    assert CheckpointFile(path).extra == {"imported": "LocusGS weights w.safetensors"}
    text = path.with_suffix(".yaml").read_text()
    assert model.recipe == resolve(path.with_suffix(".yaml")).tree
    assert "queries:\n    type: locus/anchored\n    count: 12\n" in text
    assert "#   losses: photometric, visibility, and anchor visibility" in text


REDUCED = (
    "width=48 heads=3 queries.count=5 encoder.latents=7 encoder.depth=6 encoder.blocks=[2,4,6] "
    "encoder.latent_depth=2 encoder.patch_size=4"
)


def test_a_latent_checkpoint_gives_the_recipe_of_its_preset():
    """All reduced, two as published."""
    latent = sorted(RECIPES.glob("tokengs/latent_?views_*.yaml"))
    assert len(latent) == 6
    dynamic = RECIPES / "tokengs/dynamic.yaml"
    for preset, options, latents in (
        *((preset, REDUCED, 7) for preset in latent),
        (dynamic, f"{REDUCED} queries.dynamic=2 queries.patch_size=4", 7),
        (dynamic, "", 4096),
    ):
        recipe = resolve(preset, [f"model.{option}" for option in options.split()])
        known = names_of(recipe)
        shapes = {theirs: known.shapes[ours] for ours, theirs in known.published.items()}
        assert shapes["enc_dec_backbone.latents"][0] == latents
        layout, tree = fitting_recipe(shapes, "file")
        assert layout is TOKENGS_2026_6
        read = resolve(tree)
        models = ({"model": one.tree["model"]} for one in (recipe, read))
        assert differing_predictions(*models) == {}
        assert read.views.frame == recipe.views.frame == "mean_cam"
        assert read.views.scale_factor == recipe.views.scale_factor
        assert read.evaluation.tuning == "latents"


def test_every_ablation_has_a_published_name_for_each_parameter():
    recipes = [*RECIPES.glob("ablations/*.yaml")]
    assert len(recipes) == 11
    shallow = "model={encoder: {depth: 2}, decoder: {depth: 2}, supervision: {layers: [2]}}"
    for recipe in recipes:
        known = names_of(resolve(recipe, [shallow]))
        assert known.published.keys() == known.shapes.keys()
        assert not {*known.unused} & {*known.published.values()}


def test_every_difference_is_listed_at_once():
    weights = dict(TOKENGS_A)
    known = names_of(resolve(TOKENGS.read(shapes_of(weights))))
    del weights["gs_tokens"]
    weights["activation_head.deconv.bias"] = torch.zeros(3)
    weights |= {"stranger": torch.zeros(1), "gs_anchor_xyz_raw": torch.zeros(1)}
    error = must_refuse(None, known.from_published, weights, kind=PublishedError)
    assert str(error).endswith("""
  missing: gs_tokens
  unexpected: stranger
  unexpected: gs_anchor_xyz_raw
  shape of activation_head.deconv.bias: (3,) in the file, (56,) in the recipe""")


def test_other_precisions_are_converted_and_told(tmp_path):
    for kind in ("float16", "bfloat16", "float64"):
        weights = {name: tensor.to(getattr(torch, kind)) for name, tensor in LOCUS.items()}
        told = imported(tmp_path / kind, weights)
        assert f"converted to float32: 109 of 109 are {kind}" in "".join(told)
        made = load_file(tmp_path / kind / "made.safetensors")
        assert_equal(made["queries.center"], weights["gs_anchor_xyz_raw"].float())


def test_parameters_that_share_memory_or_lie_in_strides(tmp_path):
    weights = dict(TOKENGS_A)
    tied = [name for name in weights if name.endswith("q_norm.weight")]
    weights |= dict.fromkeys(tied, weights[tied[0]])
    strided = "enc_dec_backbone.kv_proj.weight"
    weights[strided] = weights[strided].t().contiguous().t()
    torch.save(weights, tmp_path / "w.pt")
    import_weights(tmp_path / "w.pt", None, tmp_path / "c.safetensors")
    arrived(tmp_path / "c.safetensors", weights)


def test_weights_that_are_no_numbers_are_refused(tmp_path):
    for value in (torch.nan, torch.inf):
        broken = TOKENGS_A["gs_tokens"].clone()
        broken[3, 5] = value
        for tokens in (broken, broken.nan_to_num(0, 0).long()):
            must_refuse("gs_tokens", imported, tmp_path, TOKENGS_A | {"gs_tokens": tokens})
    assert names_in(tmp_path) == {"w.safetensors"}


def test_nothing_is_overwritten(tmp_path):
    for name in ("made.safetensors", "made.yaml"):
        (tmp_path / name).touch()
        must_refuse(name, imported, tmp_path, TOKENGS_A, kind=FileExistsError)
        (tmp_path / name).unlink()


def test_no_checkpoint_stays_without_its_recipe(tmp_path, monkeypatch):
    full = Mock(side_effect=OSError("no space left"))
    monkeypatch.setattr("qgs_research.published.importing.write_text", full)
    must_refuse("no space left", imported, tmp_path, TOKENGS_A, kind=OSError)
    assert names_in(tmp_path) == {"w.safetensors"}


def test_one_prefix_of_all_names_is_removed(tmp_path):
    for prefix in ("model.", "module.", "ema_model.module.", "net._orig_mod."):
        weights = {prefix + name: tensor for name, tensor in LOCUS.items()}
        report = imported(tmp_path / prefix, weights)
        assert prefix in report[0]
        assert "109 tensors used" in report[1]


def test_the_command_lists_every_tensor_and_setting(tmp_path):
    weights = tmp_path / "locus.safetensors"
    out = tmp_path / "made/c.safetensors"
    save_file(LOCUS, weights)
    option = "model.head.scale_cap=0.1"
    told = run_qgs(f"import {weights} --recipe auto --out {out} --set {option}").output
    assert "LocusGS (leo-frank/LocusGS): 109 tensors used" in told
    assert "  enc_dec_backbone.decoder_blocks.1.gs_cross_attn.tau_sample\n" in told
    assert "model.head.scale_cap: 0.1 (LocusGS: 0.075)" in told
    again = tmp_path / "again.safetensors"
    run_qgs(f"import {weights} --recipe {out.with_suffix('.yaml')} --out {again}")
    assert qgs.load(again).recipe == qgs.load(out).recipe
