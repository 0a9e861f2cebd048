"""What each option of a release says in a recipe, at values that are no defaults."""

import yaml
from golden.files import GOLDEN, OF_KIND, recipe_with

from qgs.composer.recipe import flat

CASES = yaml.safe_load((GOLDEN / "released_options.yaml").read_text())
"""Kind of release, "both" for the first two, to pairs: options, and what the model's part says."""


def test_an_option_says():
    wrong = []
    for kind in OF_KIND:
        before = flat(recipe_with(kind, {}).tree["model"])
        both = CASES["both"] if kind in ("tokengs", "locusgs") else []
        for options, says in both + CASES[kind]:
            recipe = flat(recipe_with(kind, options).tree["model"])
            told = {path: recipe.get(path) for path in says}
            if told != says or (told.items() <= before.items() and "geo_sigma" not in options):
                wrong.append((kind, options, told))
    assert wrong == []
