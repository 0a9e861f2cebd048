"""Text of recipes, merging as an operation, and what is built from a resolved recipe."""

import random
from pathlib import Path

import torch
import yaml
from refusals import refused
from tables import assert_equal, must_refuse, rows

from qgs.recipe import compose, resolve
from qgs.recipe.errors import Problems
from qgs.recipe.yaml_text import dump, inline, load_text

SMALL = yaml.safe_load("""
recipe: 1
model:
  width: 16
  heads: 2
  encoder: {depth: 1}
  queries: {count: 4}
  decoder: {depth: 3}
  head: {gaussians_per_query: 2}
  supervision: {layers: [3]}
""")
SCALARS = """
1e-4 = 0.0001
1. = 1.0
.5 = 0.5
-3 = -3
0o17 = 15
0xff = 255
017 = 17
1_000 = '1_000'
off = 'off'
yes = 'yes'
12:30 = '12:30'
2024-01-01 = '2024-01-01'
true = True
False = False
~ = None
 = None
'1' = '1'
-.inf = -inf
"""
"""Text, value in Python."""
ODD = "null,- a,a: b,# a,a #b,&a,[,2e5,.nan"
"""Texts that are something else in YAML when they stand without quotes."""


def test_scalars_are_those_of_yaml_12():
    scalars = dict(rows(SCALARS, " = "))
    assert {text: repr(load_text(text, "f", Problems())) for text in scalars} == scalars


def test_what_is_dumped_is_read_back():
    draw = random.Random(0)
    letters = [*map(chr, [*range(1, 0x250), *range(0x2000, 0x2100), 0xFEFF, 0xFFFD, 0x1F600])]
    texts = ["".join(draw.choices(letters, k=draw.randrange(7))) for _ in range(150)]
    texts += [*SCALARS.split("\n"), *SCALARS.split(), *ODD.split(",")]
    numbers = [2**63 - 1, 1 - 2**63, -0.0, 1e308, 5e-324, float("inf")]
    numbers += [draw.uniform(-9, 9) * 10 ** draw.randrange(-20, 20) for _ in range(50)]
    value = {text: [text, draw.choice(numbers), {text: None}] for text in texts}
    value["scalars"] = [*texts, *numbers, None, True, [], {}]
    assert load_text(dump(value), "f", Problems()) == value
    assert load_text(inline(value), "f", Problems()) == value


def test_same_recipe_same_parameters_and_the_global_random_state_stays():
    before = torch.get_rng_state()
    first = compose(SMALL).state_dict()
    second = compose(SMALL).state_dict()
    other = compose(SMALL, ["seed=1"]).queries.features
    assert_equal(torch.get_rng_state(), before)
    assert_equal(first, second)
    assert not torch.equal(first["queries.features"], other)


def test_layers_with_equal_refinement_share_a_module_unless_it_forbids_that(installed):
    overrides = ["plugins=[mine]", "model.decoder.refinement.type=mine/apart"]
    assert len(compose(SMALL, device="meta").refinements) == 1
    assert len(compose(SMALL, overrides, device="meta").refinements) == 3


def test_mappings_and_files_that_hold_no_recipe(tmp_path):
    knot = {"recipe": 1}
    knot["model"] = knot
    for recipe in (knot, SMALL | {"seed": b"1"}):
        assert refused(recipe).file == "<mapping>"
    assert "Tensor" in refused(SMALL | {"seed": torch.zeros(1)}).reason
    assert resolve(SMALL | {"init_from": Path("a")}).init_from == "a"
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"recipe: \xff\n")
    for path in (tmp_path, binary):
        assert refused(path).file == str(path)
    must_refuse("this recipe has no data", resolve(SMALL).build_data)
