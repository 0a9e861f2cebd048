"""What each option of a release says in a recipe, at values that are no defaults."""

from pathlib import Path

import yaml
from published.files import read_golden
from published.models import RECIPES

from qgs.recipe import resolve
from qgs.recipe.recipe import flat

FOLDER = Path(__file__).parent
CASES = yaml.safe_load((FOLDER / "released_options.yaml").read_text())
"""Kind of release, "both" for the first two, to pairs: options, and what the model's part says."""
FILES = {
    "tokengs": "tokengs_a",
    "latent": "tokengs_latent_a",
    "multiscale": "tokengs_multiscale_a",
    "dynamic": "tokengs_dynamic_a",
    "locusgs": "locus_full_a",
}


def model_with(kind, options):
    """The model's part of the recipe of a golden file with some other options."""
    golden = read_golden(FOLDER / f"{FILES[kind]}.safetensors")
    write = RECIPES.get(kind, RECIPES["tokengs"])
    return flat(resolve(write(golden.config["options"] | options)).tree["model"])


def test_an_option_says():
    wrong = []
    for kind in FILES:
        before = model_with(kind, {})
        both = CASES["both"] if kind in ("tokengs", "locusgs") else []
        for options, says in both + CASES[kind]:
            recipe = model_with(kind, options)
            told = {path: recipe.get(path) for path in says}
            if told != says or (told.items() <= before.items() and "geo_sigma" not in options):
                wrong.append((kind, options, told))
    assert wrong == []
