"""Components in combination run, forward and backward, or are refused when composed."""

import json
from itertools import product

import pytest
import yaml
from qgs_dev import cases_of
from qgs_dev.checks.fields import run_training_step
from refusals import problems_of

from qgs.recipe import resolve
from qgs.recipe.registry import load_plugin

RECIPE = yaml.safe_load("""
recipe: 1
plugins: [locus, tokengs2026, ellipsoid]
model:
  width: 32
  heads: 2
  encoder: {depth: 0}
  decoder: {depth: 2}
  head: {gaussians_per_query: 1}
  supervision: {layers: [1, 2]}
  renderer: {type: qgs/torch}
losses: {photometric: {type: qgs/photometric}}
""")
PATHS = ("queries", "decoder.cross_attention", "decoder.self_attention", "decoder.refinement",
         "centers")  # fmt: skip
PRIME = 11
"""At least the choices of any slot."""


def choices(path):
    """Every component of a slot, with its default options and with its plugin's examples."""
    found = []
    for name in ("qgs", *RECIPE["plugins"]):
        installed = load_plugin(name)
        cases = [case for case in cases_of(installed) if case.slot == path.split(".")[-1]]
        found += [(f"{name}/{case.component.name}", case) for case in cases]
    return found


def pairwise(slots):
    """Combinations in which every two choices of two slots meet, as lines of a finite plane do."""
    assert max(map(len, slots)) <= PRIME
    for offset, slope in product(range(PRIME), repeat=2):
        line = [(offset + slope * place) % PRIME for place in range(len(slots))]
        yield [slot[point % len(slot)] for slot, point in zip(slots, line, strict=True)]


def unmet(cases):
    """Fields of the state that a component of two layers reads and does not find as it reads it."""
    unmet = set()
    given = {}
    for case in (*cases[:4], *cases[1:]):
        needed = {(n, spec) for n, spec in case.reads.items() if "memory." not in n}
        unmet |= dict(needed - given.items()).keys()
        given |= case.writes
    return unmet


@pytest.mark.parametrize("parts", list(pairwise([choices(path) for path in PATHS])))
def test_every_two_options_run_together_or_are_refused_with_all_that_they_lack(parts):
    overrides = []
    for path, (kind, case) in zip(PATHS, parts, strict=True):
        options = case.with_at_most(count=6, dynamic=2).config.model_dump(mode="json")
        overrides.append(f"model.{path}={json.dumps({'type': kind, **options})}")
    told = str(problems_of(RECIPE, overrides))
    lacking = unmet([case for _, case in parts])
    assert all(field in told for field in lacking)
    if not lacking:
        run_training_step(resolve(RECIPE, overrides), parts[0][1])
