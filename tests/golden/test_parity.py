"""The comparison on files with something wrong."""

import parity
import torch
from golden.files import GOLDEN, changed, compared_names, options_of
from published.files import GoldenFile, read_golden
from published.models import DECODER_MLP, recipe_of


def test_the_weights_tell_a_ratio_that_is_not_whole():
    weights = {f"weights.{DECODER_MLP}": torch.zeros(160, 64)}
    recipe = recipe_of(GoldenFile(weights, {"kind": "tokengs", "options": options_of("tokengs")}))
    assert recipe["model"]["decoder"]["feed_forward"] == {"ratio": 2.5}


def rows_of(path):
    return {row.name: row for row in parity.rows_of(path)}


def problems(path):
    return {name: row.problem for name, row in rows_of(path).items() if row.problem}


STRAYS = {
    "locus_full_a": "expected",
    "tokengs_a": "anchor_center.0",
    "tokengs_latent_a": "tokens.3",
    "loss_a": "expected.tokengs.nossim.loss_lpips",
}


def test_altered_and_added_tensors_fail_by_name_and_others_pass(tmp_path):
    """In files in float64."""
    for source, stray in STRAYS.items():
        expected = {stray: "not compared: nothing here has this name"}
        names = compared_names(read_golden(GOLDEN / f"{source}.safetensors"))[::2]

        def alter(tensors, expected=expected, names=names, stray=stray):
            for name, tensor in tensors.items():
                tensors[name] = tensor.double() if tensor.is_floating_point() else tensor
            for name in names:
                last = tuple(tensors[name].isfinite().nonzero()[-1])
                tensors[name][last] += 1e-3 + 1e-3 * tensors[name][last].abs()
                expected[name] = f"1 of {tensors[name].numel()} beyond tolerance"
            tensors[stray] = torch.zeros(2)

        assert problems(changed(tmp_path / "file", source, alter)) == expected


def test_numbers_that_are_not_finite_and_missing_tensors_fail_by_name(tmp_path):
    def alter(tensors):
        tensors["keys"].fill_(torch.nan)
        del tensors["geo_bias.1"]

    rows = rows_of(changed(tmp_path / "file", "locus_full_a", alter))
    assert {name for name, row in rows.items() if row.problem} == {"keys", "geo_bias.1"}
    assert rows["geo_bias.1"].problem == "listed in the metadata, missing in the file"
    assert rows["keys"].absolute == rows["keys"].relative == torch.inf
    assert rows["values"].absolute < 1e-4

    def turn(tensors):
        pixels = tensors["expected.tokengs.means2d"]
        pixels[pixels.isinf()] *= -1

    found = problems(changed(tmp_path / "file", "loss_a", turn))
    assert found == {"expected.tokengs.means2d": "4 of 480 beyond tolerance"}


def test_a_wrong_option_or_constant_does_not_pass(tmp_path):
    passed = []
    for source, wrong in (
        ("locus_full_a", {"gaussian_scale_cap": 0.08}),
        ("locus_full_a", {"anchor_radius_min": 0.5}),
        ("locus_full_a", {"anchor_radius_affects_bias": False}),
        ("locus_full_a", {"self_attn_variant": "content_only"}),
        ("tokengs_a", {"gaussian_z_offset": 1.5}),
        ("tokengs_a", {"enc_num_heads": 2}),
    ):
        if parity.report(changed(tmp_path / "file", source, options=wrong)):
            passed.append((source, wrong))
    assert passed == []
    path = changed(tmp_path / "file", "locus_center_only_bias_a", geo_sigma=0.2)
    assert "geo_bias.0" in problems(path)
