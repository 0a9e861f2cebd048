"""What each option of a release says in a recipe, at values that are no defaults."""

from typing import Any

import pytest
from golden.dumped import metadata
from published.locus import locusgs_recipe
from published.tokengs import tokengs_recipe

from qgs.composer import resolve
from qgs.composer.recipe import flat

BACKBONE = [
    ({"enc_embed_dim": 48, "token_dim": 48}, {"width": 48}),
    ({"enc_num_heads": 8}, {"heads": 8}),
    ({"patch_size": 4}, {"encoder.patch_size": 4}),
    ({"enc_depth": 5}, {"encoder.depth": 5}),
    ({"mlp_ratio": 2.5}, {"encoder.mlp_ratio": 2.5}),
    ({"gaussian_scale_cap": 0.3}, {"head.scale_cap": 0.3}),
    ({"num_gs_tokens": 31}, {"queries.count": 31}),
    ({"gs_token_std": 0.4}, {"queries.std": 0.4}),
]
TOKENGS = [
    *BACKBONE,
    ({"dec_depth": 3}, {"decoder.depth": 3, "supervision.layers": [3]}),
    ({"dec_patch_size": 3}, {"head.gaussians_per_query": 9}),
    ({"opacity_bias": 3.5}, {"head.opacity_bias": -3.5}),
    ({"gaussian_z_offset": 2.5}, {"centers.z_offset": 2.5}),
]
LOCUSGS = [
    *BACKBONE,
    ({"dec_depth": 3}, {"decoder.depth": 3}),
    ({"num_gaussians_per_token": 7}, {"head.gaussians_per_query": 7}),
    ({"anchor_supervision_layers": [2]}, {"supervision.layers": [2]}),
    ({"gaussian_z_offset": 2.5}, {"queries.center_init.mean": [0.0, 0.0, 2.5]}),
    ({"anchor_radius_init": 0.3}, {"queries.init_radius": 0.3}),
    (
        {"anchor_radius_min": 0.02},
        {
            "queries.radius_min": 0.02, "centers.radius_min": 0.02,
            "decoder.cross_attention.radius_min": 0.02, "decoder.refinement.radius_min": 0.02,
        },
    ),
    ({"anchor_radius_refinement": False}, {"decoder.refinement.radius": False}),
    (
        {"anchor_radius_affects_bias": False, "geo_sigma": 0.7},
        {"decoder.cross_attention.bandwidth": "fixed", "decoder.cross_attention.sigma0": 0.7},
    ),
    (
        {"anchor_radius_affects_bias": False},
        {"decoder.cross_attention.bandwidth": "fixed", "decoder.cross_attention.sigma0": 0.1},
    ),
    ({"geo_sigma": 0.7}, {"decoder.cross_attention.sigma0": 0.7}),
    ({"cross_attn_variant": "content_only"}, {"decoder.cross_attention.type": "qgs/content"}),
    ({"self_attn_variant": "content_only"}, {"decoder.self_attention.type": "qgs/content"}),
    ({"gaussian_center_variant": "anchor_offset"}, {"centers.type": "locus/anchor_offset"}),
    ({"gaussian_center_variant": "free_center"}, {"centers.type": "qgs/free"}),
]  # fmt: skip
MULTISCALE = [
    ({"enc_depth": 4, "multiscale_encoder_layers": [3, 1]}, {"encoder.blocks": [2, 4]}),
    ({"use_multiscale_encoder": False}, {"encoder.type": "qgs/multiview_vit"}),
]
LATENT = [
    ({"num_latents": 5}, {"encoder.latents": 5}),
    ({"latent_cross_attn_depth": 5}, {"encoder.latent_depth": 5}),
    ({"use_multiscale_encoder": False}, {"encoder.blocks": [4]}),
    ({"use_latent_bottleneck": False}, {"encoder.type": "tokengs2026/multiscale_vit"}),
]
DYNAMIC = [
    (
        {"num_dynamic_gs_tokens": 3},
        {"queries.count": 15, "queries.dynamic": 3, "queries.type": "tokengs2026/dynamic"},
    ),
    ({"num_dynamic_gs_tokens": 0}, {"decoder.self_attention.type": "qgs/content"}),
    ({"time_embedding_dim": 6}, {"encoder.time_channels": 6, "queries.time_channels": 6}),
    ({"time_embedding": False}, {"encoder.time_channels": 0, "queries.time_channels": 0}),
]
CASES = [("tokengs", *case) for case in TOKENGS] + [("locusgs", *case) for case in LOCUSGS]
CASES += [("multiscale", *case) for case in MULTISCALE] + [("latent", *case) for case in LATENT]
CASES += [("dynamic", *case) for case in DYNAMIC]


@pytest.mark.parametrize(("kind", "options", "says"), CASES, ids=str)
def test_an_option_says(kind: str, options: dict[str, Any], says: dict[str, Any]) -> None:
    read = locusgs_recipe if kind == "locusgs" else tokengs_recipe
    unchanged = metadata(kind)["options"]
    recipe = flat(resolve(read(unchanged | options)).tree["model"])
    assert {path: recipe[path] for path in says} == says
    before = flat(resolve(read(unchanged)).tree["model"])
    assert "geo_sigma" in options or any(before.get(path) != says[path] for path in says)


def test_no_radius_state() -> None:
    options = {
        "use_anchor_radius": False, "anchor_radius_affects_bias": False,
        "anchor_radius_refinement": False, "gaussian_center_variant": "anchor_offset",
    }  # fmt: skip
    tree = resolve(locusgs_recipe(metadata("locusgs")["options"] | options)).tree
    assert tree["model"]["queries"]["radius"] is False
