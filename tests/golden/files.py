"""The golden files, and files that are like them but for a change."""

import json
from functools import cache
from pathlib import Path

from published.files import read_golden
from published.models import RECIPES
from safetensors.torch import save_file

from qgs.composer import resolve

GOLDEN = Path(__file__).parent
OF_KIND = {
    "tokengs": "tokengs_a",
    "latent": "tokengs_latent_a",
    "multiscale": "tokengs_multiscale_a",
    "dynamic": "tokengs_dynamic_a",
    "locusgs": "locus_full_a",
}
INPUTS = {
    "alphas_pred", "c2w", "has_mask", "images_gt", "images_pred", "intrinsics", "masks_gt",
    "opacity", "points", "rgb", "target_time", "times", "tuned_latents"
}  # fmt: skip
"""Of files of models and of losses."""


def compared_names(golden):
    """The tensors of a file that are neither inputs nor weights."""
    return [
        name for name in golden.tensors if not name.startswith("weights.") and name not in INPUTS
    ]


@cache
def options_of(kind):
    """The options of the golden file of that kind."""
    return read_golden(GOLDEN / f"{OF_KIND[kind]}.safetensors").config["options"]


def recipe_with(kind, options):
    """The recipe of that kind with some other options."""
    return resolve(RECIPES.get(kind, RECIPES["tokengs"])(options_of(kind) | options))


def changed(path, source, alter=dict, **config):
    """A golden file after `alter(tensors)`, at `path`; some other `options` or constants."""
    golden = read_golden(GOLDEN / f"{source}.safetensors")
    alter(golden.tensors)
    if "options" in config:
        config["options"] = golden.config["options"] | config["options"]
    contiguous = {name: tensor.contiguous().clone() for name, tensor in golden.tensors.items()}
    save_file(contiguous, path, {"config": json.dumps(golden.config | config)})
    return path
