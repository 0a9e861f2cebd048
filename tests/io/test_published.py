"""Published state dicts under our names and back; what no layout can hold is refused."""

from pathlib import Path
from typing import Any

import pytest
import torch
from golden_weights import published

from qgs.components import TOKENGS
from qgs.composer import Recipe, resolve
from qgs.io.differences import options_beside_weights, shapes_of
from qgs.io.published import PublishedError, exact_names_of, fitting_recipe, names_of

RECIPES = Path(__file__).parents[2] / "recipes"
SMALL = ("model.width=16", "model.heads=2", "model.queries.count=8", "model.decoder.depth=2")
TOKENGS_MODEL: dict[str, Any] = {"recipe": 1}
LOCUS_MODEL: dict[str, Any] = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {
        "queries": {"type": "locus/anchored"},
        "decoder": {
            "cross_attention": {"type": "locus/ray_biased"},
            "self_attention": {"type": "locus/anchor_aware"},
            "refinement": {"type": "locus/refine"},
        },
        "centers": {"type": "locus/radius_scaled"},
    },
}


def small(tree: dict[str, Any], *overrides: str) -> Recipe:
    return resolve(tree, [*SMALL, "model.supervision.layers=[2]", *overrides])


@pytest.mark.parametrize("file", ["a", "latent_a", "multiscale_a", "dynamic_a"])
def test_names_survive_both_ways(file: str) -> None:
    weights = published(f"tokengs_{file}")
    recipe = resolve(TOKENGS.read(shapes_of(weights)))
    ours = names_of(recipe).from_published(weights)
    back = exact_names_of(recipe).to_published(ours)
    assert back.keys() == weights.keys()
    assert all(back[name] is weights[name] for name in weights)


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
    names = exact_names_of(recipe)
    theirs = names.published_shapes()
    assert theirs["enc_dec_backbone.latents"] == (
        sizes.get("encoder.latents", 4096),
        names.shapes["queries.features"][1],
    )
    layout, tree = fitting_recipe(theirs, "file")
    assert layout is TOKENGS
    read = resolve(tree)
    assert (
        options_beside_weights({"model": recipe.tree["model"]}, {"model": read.tree["model"]}) == {}
    )
    assert read.views.frame == recipe.views.frame == "mean_cam"
    assert read.views.scale_factor == recipe.views.scale_factor
    assert read.evaluation.tuning == "latents"


def test_a_readout_of_more_blocks_than_there_are_fits_no_recipe() -> None:
    shapes = shapes_of(published("tokengs_latent_a"))
    shapes |= {f"enc_dec_backbone.multiscale_norms.{n}.weight": (32,) for n in range(2, 5)}
    with pytest.raises(PublishedError, match="5 norms, one for each block read, of 4 blocks"):
        fitting_recipe(shapes, "file")


def test_latents_of_the_last_block_are_read_once_its_norm_is_renamed() -> None:
    """The release with `use_multiscale_encoder: False`, which parity is checked with."""
    recipe = resolve(RECIPES / "tokengs/latent_2views_ssim.yaml", [*SMALL, "model.encoder.depth=1",
                     "model.encoder.blocks=[1]", "model.supervision.layers=[2]"])  # fmt: skip
    renamed = exact_names_of(recipe).published_shapes()
    one, other = "enc_dec_backbone.multiscale_norms.0", "enc_dec_backbone.encoder_norm"
    shapes = {name.replace(one, other): shape for name, shape in renamed.items()}
    with pytest.raises(PublishedError, match=f"without {one}: .* name its norm {other}; rename"):
        fitting_recipe(shapes, "file")
    encoder = resolve(fitting_recipe(renamed, "file")[1]).tree["model"]["encoder"]
    assert (encoder["type"], encoder["blocks"]) == ("qgs/latent_bottleneck", [1])


@pytest.mark.parametrize("recipe", sorted(RECIPES.glob("ablations/*.yaml")), ids=lambda p: p.stem)
def test_every_ablation_has_a_published_name_for_each_parameter(recipe: Path) -> None:
    resolved = resolve(recipe)
    names = exact_names_of(resolved)
    assert not names.unnamed
    assert names.published.keys() == names.shapes.keys()
    assert not names.mismatches(names.published_shapes())
    assert not set(names.unused) & set(names.published.values())


def test_the_published_size_counts_its_unused_parameters() -> None:
    recipe = resolve(RECIPES / "locus/dl3dv_4096_4views.yaml")
    names = names_of(recipe)
    width, head, layers = 1024, 64, 12
    sizes = {"_pos_norm": head, "anchor_norm": width, "plucker_norm": width, "tau_sample": 1}
    unused = sum(size for n in names.unused for part, size in sizes.items() if part in n)
    assert unused == layers * (2 * 2 * width + 2 * 2 * head + 1) == 52_236


def test_every_difference_is_listed_at_once() -> None:
    weights = published("tokengs_a")
    recipe = resolve(TOKENGS.read(shapes_of(weights)))
    del weights["gs_tokens"], weights["patch_embed.norm.bias"]
    weights["activation_head.deconv.bias"] = torch.zeros(3)
    weights["stranger"] = torch.zeros(1)
    with pytest.raises(PublishedError) as caught:
        names_of(recipe).from_published(weights)
    for words in (
        "4 differences",
        "missing: gs_tokens",
        "missing: patch_embed.norm.bias",
        "unexpected: stranger",
        "shape of activation_head.deconv.bias: (3,) in the file, (56,) in the recipe",
    ):
        assert words in str(caught.value)


def test_a_tokengs_recipe_accepts_no_key_of_an_anchor() -> None:
    weights = published("tokengs_a")
    recipe = resolve(TOKENGS.read(shapes_of(weights)))
    stray = ("gs_anchor_xyz_raw", "enc_dec_backbone.decoder_blocks.0.gs_cross_attn.tau_sample")
    with pytest.raises(PublishedError, match="2 differences") as caught:
        names_of(recipe).from_published(weights | {name: torch.zeros(1) for name in stray})
    assert all(f"unexpected: {name}" in str(caught.value) for name in stray)


@pytest.mark.parametrize(
    ("tree", "overrides", "words"),
    [
        (TOKENGS_MODEL, ["model.head.norm=true"], ["head.norm.weight", "no such parameter"]),
        (
            LOCUS_MODEL,
            ["model.decoder.refinement.center=false"],
            ["refinements.0.center_mlp.fc1.weight", "this model has no such parameter"],
        ),
        (
            LOCUS_MODEL,
            ["model.decoder.layers={1: {refinement: {zero_init: true}}}"],
            ["refinements.1.center_mlp.fc1.weight: LocusGS has no such parameter"],
        ),
        (
            LOCUS_MODEL,
            ["model.decoder.layers={0: {self_attention: {type: qgs/content}}}"],
            ["TokenGS: model.queries is locus/anchored", "layers differ in their self_attention"],
        ),
        (
            {
                **TOKENGS_MODEL,
                "model": {"decoder": {"layers": {1: {"feed_forward": {"ratio": 2}}}}},
            },
            [],
            ["decoder.1.feed_forward.mlp.fc1.weight", "(64, 16), this model has (32, 16)"],
        ),
    ],
)
def test_models_that_no_layout_holds_are_refused(
    tree: dict[str, Any], overrides: list[str], words: list[str]
) -> None:
    with pytest.raises(PublishedError) as caught:
        exact_names_of(small(tree, *overrides))
    for part in words:
        assert part in str(caught.value)


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_tiny_models_leave_and_come_back(name: str) -> None:
    recipe = resolve(RECIPES / f"tiny/{name}.yaml", ["model.head.norm=false", *SMALL[:3]])
    model = recipe.build_model()
    weights = dict(model.state_dict())
    names = exact_names_of(recipe)
    back = names.from_published(names.to_published(weights))
    assert back.keys() == weights.keys()
    assert all(back[key] is weights[key] for key in weights)
