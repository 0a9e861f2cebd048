"""The model of a golden file: composed from the published options, filled with its weights."""

from collections.abc import Callable, Mapping
from typing import Any

from qgs_research.published.layouts import names_of
from torch import Tensor

from published.depthsplat import depthsplat_tensors
from published.files import GoldenFile, GoldenFileError
from published.locus import locusgs_recipe
from published.mvsplat import mvsplat_tensors
from published.recording import model_tensors
from published.splat_cases import cases_tensors
from published.tokengs import tokengs_recipe
from qgs.contracts.weights import real_ratio
from qgs.recipe import resolve
from qgs.types import Cameras, Views

RECIPES: Mapping[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "tokengs": tokengs_recipe,
    "locusgs": locusgs_recipe,
}

COMPUTED: Mapping[str, Callable[[GoldenFile], dict[str, Tensor]]] = {
    "mvsplat": mvsplat_tensors,
    "mvsplat_cases": cases_tensors,
    "depthsplat": depthsplat_tensors,
    "depthsplat_cases": cases_tensors,
}
"""Kinds of files whose weights and inputs are stored in another way."""

TIMES = ("times", "target_time")
TUNED = "tuned_latents"
LAST_NORM = "enc_dec_backbone.encoder_norm."
READ_NORM = "enc_dec_backbone.multiscale_norms.0."
DECODER_MLP = "enc_dec_backbone.decoder_blocks.0.mlp.mlp.fc1.weight"


def golden_tensors(golden: GoldenFile) -> dict[str, Tensor]:
    """All tensors that the file may hold, computed by its model on its photos and cameras.

    Raises GoldenFileError for a file that contradicts itself or lacks something, and ValueError
    for options that no recipe can express.
    """
    if golden.config.get("kind") in COMPUTED:
        return COMPUTED[golden.config["kind"]](golden)
    recipe = resolve(recipe_of(golden))
    model = recipe.build_model().eval()
    weights = golden.weights()
    # Runs that read one block name its norm as TokenGS does.
    if hasattr(model.encoder, "norms"):
        weights = {name.replace(LAST_NORM, READ_NORM): x for name, x in weights.items()}
    model.load_state_dict(names_of(recipe).from_published(weights), strict=True)
    cameras = Cameras(golden.input("c2w"), golden.input("intrinsics"), golden.size)
    times = (golden.input(name) if name in golden.tensors else None for name in TIMES)
    views = Views(golden.input("rgb"), cameras, None, *times)
    tuned = golden.input(TUNED) if TUNED in golden.tensors else None
    return model_tensors(model, views, tuned)


def recipe_of(golden: GoldenFile) -> dict[str, Any]:
    """The recipe of the model that a file was computed with; raises as `golden_tensors` does."""
    kind = golden.config.get("kind")
    if not isinstance(kind, str) or kind not in RECIPES:
        known = ", ".join([*RECIPES, *COMPUTED])
        raise GoldenFileError(f"the kind of model is {kind!r}; known are {known}")
    constants = {name: golden.config[name] for name in ("geo_sigma",) if name in golden.config}
    recipe = RECIPES[kind](golden.options("options", constants))
    model = recipe["model"]
    _expect_agreement(golden, "gaussians_per_token", model["head"]["gaussians_per_query"])
    _expect_agreement(golden, "anchor_radius_min", model["queries"].get("radius_min"))
    weights = golden.weights()
    # The releases have no option for it.
    if DECODER_MLP in weights:
        hidden, width = weights[DECODER_MLP].shape
        model["decoder"]["feed_forward"] = {"ratio": real_ratio(hidden, width, DECODER_MLP)}
    return recipe


def _expect_agreement(golden: GoldenFile, name: str, from_options: Any) -> None:
    stated = golden.config.get(name)
    if None not in (stated, from_options) and stated != from_options:
        raise GoldenFileError(
            f"the metadata contradicts itself: {name} is {stated}, by its options {from_options}"
        )
