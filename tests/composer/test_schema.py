"""The JSON Schema agrees with the composer, and the committed copy with the code."""

import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from qgs.composer.registry import available_plugins, load_registry
from qgs.composer.schema import recipe_schema

RECIPES = Path(__file__).parents[2] / "recipes"
SHIPPED = ["c3g", "datasets", "dinov2", "ellipsoid", "globalsplat", "gslrm", "landmark", "locus"]
SHIPPED += ["lpips", "mvsplat", "rooms", "tokengs2026", "worlds"]


@pytest.fixture(scope="module")
def schema():
    if missing := set(SHIPPED) - set(available_plugins()):
        pytest.skip(f"the committed schema covers plugins that are not installed: {missing}")
    return recipe_schema(load_registry(SHIPPED))


@pytest.fixture(scope="module")
def validate(schema):
    """Raises ValidationError; made once, for `jsonschema.validate` checks the schema each time."""
    return jsonschema.Draft202012Validator(schema).validate


def test_committed_schema_is_fresh(schema):
    committed = json.loads((RECIPES / "recipe.schema.json").read_text())
    assert committed == schema, "run `qgs schema --out recipes/recipe.schema.json`"


def undescribed(schema, path=()):
    """Paths of the properties in `schema` that have no description."""
    if not isinstance(schema, dict | list):
        return
    for key, value in schema.items() if isinstance(schema, dict) else enumerate(schema):
        below = (*path, str(key))
        if path and path[-1] == "properties" and not value.get("description"):
            yield ".".join(below)
        yield from undescribed(value, below)


def test_every_key_is_described(schema):
    assert list(undescribed(schema)) == []


def test_schema_is_a_schema(schema):
    jsonschema.Draft202012Validator.check_schema(schema)


@pytest.mark.parametrize(
    "path", sorted(RECIPES.glob("*/*.yaml")), ids=lambda path: f"{path.parent.name}/{path.stem}"
)
def test_recipes_validate(path, validate):
    validate(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize(
    "recipe",
    [
        {"modle": {}},
        {"model": {"queries": {"type": "qgs/latnet"}}},
        {"model": {"queries": {"type": "qgs/latent", "count": -1}}},
        {"model": {"queries": {"cuont": 1}}},
        {"model": {"decoder": {"layers": {"x": {}}}}},
        {"training": {"precision": "fp8"}},
        {"model": {"renderer": {"dilation": {"schedule": "linaer", "from": 1, "to": 0}}}},
        {"model": {"renderer": {"dilation": {"schedule": "linear", "value": 1}}}},
        {"model": {"queries": {"count": {"schedule": "constant", "value": 1}}}},
    ],
)
def test_mistakes_do_not_validate(recipe, validate):
    with pytest.raises(jsonschema.ValidationError):
        validate(recipe)


def test_null_drops_what_is_inherited(validate):
    decoder = {"depth": 0, "cross_attention": None, "layers": {"1": {"feed_forward": None}}}
    validate({"model": {"decoder": decoder}, "losses": {"visibility": None}})


def test_schedules_validate_where_options_may_follow(validate):
    ramp = {"schedule": "cosine", "values": [1, 0.1], "at": [0, 100]}
    jumps = {"schedule": "steps", "values": [10, 1], "at": [100]}
    recipe = {
        "model": {"renderer": {"dilation": jumps, "far": ramp}},
        "losses": {"photometric": {"mse_weight": {"schedule": "constant", "value": 2}}},
    }
    validate(recipe)
