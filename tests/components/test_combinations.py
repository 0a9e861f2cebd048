"""Components in combination run, forward and backward, or are refused when composed."""

import random
from itertools import combinations, product

import pytest
from qgs_plugintools import Case
from qgs_plugintools.checks.fields import run_training_step
from qgs_plugintools.inputs import Sizes
from qgs_plugintools.plugins import cases_of

from qgs.composer import RecipeError, resolve
from qgs.composer.registry import load_registry
from qgs.contracts import Component, ComponentConfig

SLOTS = ("queries", "cross_attention", "self_attention", "refinement", "centers", "supervision")
LAYER = SLOTS[1:4]
REGISTRY = load_registry(["locus", "tokengs2026"])
DEPTH = 2
SIZES = (Sizes(), Sizes(batch=1, views=3, image=(24, 16)))
"""Of the views that every combination runs with."""

Choice = tuple[str, type[Component], ComponentConfig]


def _choices(slot):
    """Every component of a slot, with its default options and with its plugin's examples."""
    if slot == "supervision":
        component = REGISTRY.components(slot)["qgs/layers"]
        layers = component.Config
        return [("qgs/layers", component, layers(layers=chosen)) for chosen in ((1, 2), (2,))]
    return [
        (f"{name}/{case.component.name}", case.component, case.config)
        for name, installed in REGISTRY.plugins.items()
        for case in cases_of(installed)
        if case.slot == slot
    ]


CHOICES = {slot: _choices(slot) for slot in SLOTS}


def _pairwise():
    """Combinations in which every two choices of two slots meet, few by greedy choice."""
    counts = [range(len(choices)) for choices in CHOICES.values()]
    combined = list(product(*counts))
    random.Random(0).shuffle(combined)
    left = {pair for combination in combined for pair in _pairs(combination)}
    taken = []
    for gain in range(len(_pairs(combined[0])), 0, -1):
        for combination in combined:
            if len(_pairs(combination) & left) >= gain:
                left -= _pairs(combination)
                taken.append(combination)
    return [
        tuple(choices[index] for choices, index in zip(CHOICES.values(), combination, strict=True))
        for combination in taken
    ]


def _pairs(combination):
    return frozenset(combinations(enumerate(combination), 2))


def _recipe(chosen):
    def written(slot):
        kind, _, config = chosen[slot]
        options = config.model_dump(mode="json")
        fewer = {name: count for name, count in (("count", 6), ("dynamic", 2)) if name in options}
        return {"type": kind, **options, **(fewer if slot == "queries" else {})}

    return {
        "recipe": 1,
        "plugins": ["locus", "tokengs2026"],
        "model": {
            "width": 32,
            "heads": 2,
            "encoder": {"depth": 0},
            "queries": written("queries"),
            "decoder": {"depth": DEPTH, **{slot: written(slot) for slot in LAYER}},
            "head": {"gaussians_per_query": 1},
            "centers": written("centers"),
            "supervision": written("supervision"),
            "renderer": {"type": "qgs/torch"},
        },
        "losses": {"photometric": {"type": "qgs/photometric"}},
    }


def _unmet(chosen):
    """What each component needs of the state and does not find there as it reads it."""
    unmet = {}
    given = {}
    for slot in ("queries", *LAYER, *LAYER, "centers"):
        kind, component, config = chosen[slot]
        needed = {n: s for n, s in component.fields_read(config).items() if "memory." not in n}
        lacking = {name for name, spec in needed.items() if given.get(name) != spec}
        if lacking:
            unmet[kind] = unmet.get(kind, set()) | lacking
        written = component.fields_written(config).items()
        given |= {n: spec for n, spec in written if n not in needed or n in given}
    return unmet


def _check(parts):
    """A combination runs, or is refused with all that it lacks."""
    chosen = dict(zip(SLOTS, parts, strict=True))
    unmet = _unmet(chosen)
    if not unmet:
        recipe = resolve(_recipe(chosen))
        for sizes in SIZES:
            run_training_step(recipe, Case(chosen["queries"][2]), sizes)
        return
    with pytest.raises(RecipeError) as refusal:
        resolve(_recipe(chosen))
    told = str(refusal.value)
    for kind, fields in unmet.items():
        assert f"`{kind}`" in told
        assert all(field in told for field in fields)


@pytest.mark.parametrize("parts", _pairwise())
def test_every_two_options_run_together_or_are_refused(parts):
    _check(parts)


@pytest.mark.slow
@pytest.mark.parametrize("first", list(product(*list(CHOICES.values())[:2])))
def test_combinations_of_options_run_or_are_refused(first):
    # Thousands of tests would take seconds to collect whenever pytest starts.
    for rest in product(*list(CHOICES.values())[2:]):
        parts = (*first, *rest)
        print(parts)
        _check(parts)
