"""`qgs list`; the JSON Schema agrees with the composer, and the committed copy with the code."""

import json

import jsonschema
import pytest
import yaml
from commands import done
from qgs_dev.schema import recipe_schema
from size import ROOT
from tables import read_json, rows

from qgs.recipe.registry import Registry, load_plugin

COMMITTED = ROOT / "recipes/recipe.schema.json"
SHIPPED = "c3g datasets dinov2 ellipsoid globalsplat gslrm landmark locus lpips mvsplat rooms"
SHIPPED += " tokengs2026 worlds"
SOUND = """
model: {decoder: {depth: 0, cross_attention: null, layers: {1: {feed_forward: null}}}}
losses: {visibility: null}
---
model:
  renderer:
    dilation: {schedule: steps, values: [10, 1], at: [100]}
    far: {schedule: cosine, values: [1, 0.1], at: [0, 100]}
losses: {photometric: {mse_weight: {schedule: constant, value: 2}}}
"""
MISTAKEN = """
modle: {}
---
model: {queries: {type: qgs/latnet}}
---
model: {queries: {type: qgs/latent, count: -1}}
---
model: {queries: {cuont: 1}}
---
model: {decoder: {layers: {x: {}}}}
---
training: {precision: fp8}
---
model: {renderer: {dilation: {schedule: linaer, from: 1, to: 0}}}
---
model: {renderer: {dilation: {schedule: linear, value: 1}}}
---
model: {queries: {count: {schedule: constant, value: 1}}}
"""


@pytest.fixture(scope="module")
def schema():
    return recipe_schema(Registry({name: load_plugin(name) for name in ["qgs", *SHIPPED.split()]}))


def test_the_committed_schema_is_fresh_and_a_schema(schema):
    assert read_json(COMMITTED) == schema, f"run `qgs schema --out {COMMITTED.name}`"
    jsonschema.Draft202012Validator.check_schema(schema)


def test_nulls_and_schedules_are_valid_and_mistakes_are_not(schema):
    is_valid = jsonschema.Draft202012Validator(schema).is_valid
    recipes = yaml.safe_load_all(f"{SOUND}---{MISTAKEN}")
    assert [is_valid(json.loads(json.dumps(x))) for x in recipes] == [True] * 2 + [False] * 9


LISTED = """
queries; model.queries: qgs/latent, query-gaussians 0; locus/anchored
qgs/latent; count | integer > 0 | 4096 | Number N of queries.
locus/anchored; center_init.std; provides: anchor.center (3 float32, world frame)
qgs/photos; path | text | required |
model.decoder; layer_scale | number > 0 | 5.0e-05
recipe; seed; init_from
"""


def test_list_explains_options(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    for name, *parts in rows(LISTED, "; "):
        shown = done(f"list {name}").output.replace("\N{BOX DRAWINGS LIGHT VERTICAL}", "|")
        output = " ".join(shown.split())
        assert all(part in output for part in parts), output
        assert "qgs/mlp" not in output
