"""Components in combination run, forward and backward, or are refused when composed."""

import json
import random
from itertools import combinations, product

import pytest
import yaml
from qgs_dev import Case
from qgs_dev.checks.fields import run_training_step
from qgs_dev.inputs import Sizes
from qgs_dev.plugins import cases_of
from refusals import problems_of

from qgs.recipe import resolve
from qgs.recipe.registry import load_registry

RECIPE = yaml.safe_load("""
recipe: 1
plugins: [locus, tokengs2026]
model:
  width: 32
  heads: 2
  encoder: {depth: 0}
  decoder: {depth: 2}
  head: {gaussians_per_query: 1}
  renderer: {type: qgs/torch}
losses: {photometric: {type: qgs/photometric}}
""")
PATHS = ("queries", "decoder.cross_attention", "decoder.self_attention", "decoder.refinement",
         "centers", "supervision")  # fmt: skip
SIZES = (Sizes(), Sizes(batch=1, views=3, image=(24, 16)))
"""Of the views that every combination runs with."""
FEWER = {"count": 6, "dynamic": 2}
"""Queries."""


def choices(path):
    """Every component of a slot, with its default options and with its plugin's examples."""
    return [
        (f"{name}/{case.component.name}", case.component, case.config)
        for name, installed in load_registry(RECIPE["plugins"]).plugins.items()
        for case in cases_of(installed)
        if case.slot == path.split(".")[-1]
    ]


def written(path, kind, component, config):
    options = config.model_dump(mode="json")
    options |= {name: FEWER[name] for name in FEWER.keys() & options}
    if options.get("layers") == [12]:
        options["layers"] = [2]  # the last one
    return f"model.{path}={json.dumps({'type': kind, **options})}"


def unmet(parts):
    """What each component needs of the state and does not find there as it reads it."""
    unmet = {}
    given = {}
    for kind, component, config in (*parts[:4], *parts[1:5]):
        needed = {n: s for n, s in component.fields_read(config).items() if "memory." not in n}
        lacking = {name for name, spec in needed.items() if given.get(name) != spec}
        if lacking:
            unmet.setdefault(kind, set()).update(lacking)
        fields = component.fields_written(config).items()
        given |= {n: spec for n, spec in fields if n not in needed or n in given}
    return unmet


def pairs(combination):
    return set(combinations(enumerate(combination), 2))


def pairwise(slots):
    """Combinations in which every two choices of two slots meet, few by greedy choice."""
    every = [*product(*(range(len(slot)) for slot in slots))]
    random.Random(0).shuffle(every)
    left = set().union(*map(pairs, every))
    for gain in range(len(pairs(every[0])), 0, -1):
        for combination in every:
            if len(pairs(combination) & left) >= gain:
                left -= pairs(combination)
                yield [slot[index] for slot, index in zip(slots, combination, strict=True)]


@pytest.mark.parametrize("parts", list(pairwise([choices(path) for path in PATHS])))
def test_every_two_options_run_together_or_are_refused_with_all_that_they_lack(parts):
    overrides = [written(path, *part) for path, part in zip(PATHS, parts, strict=True)]
    told = str(problems_of(RECIPE, overrides))
    lacking = unmet(parts)
    for kind, fields in lacking.items():
        assert f"`{kind}`" in told
        assert all(field in told for field in fields)
    if not lacking:
        for sizes in SIZES:
            run_training_step(resolve(RECIPE, overrides), Case(parts[0][2]), sizes)
