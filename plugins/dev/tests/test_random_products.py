"""Recipes drawn from the components of all plugins: each trains, or is refused when composed."""

import tomllib
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest
import torch
from qgs_dev import Case
from qgs_dev.inputs import Maker, Sizes
from qgs_dev.running import cases_of

from qgs.contracts import SUBLAYER_SLOTS, Component
from qgs.recipe import Recipe, RecipeError, registry, resolve
from qgs.recipe.slots import SLOTS
from qgs.recipe.yaml_text import inline
from qgs.tokengs import LatentQueries
from qgs.train.training_pass import TrainingPass

KNOWN = tomllib.loads(Path(__file__).with_name("random_products.toml").read_text())
PLUGINS: list[str] = KNOWN["plugins"]
LAYER = ("layer", *SUBLAYER_SLOTS, "refinement")
DRAWN = ("encoder", "queries", *LAYER, "head", "centers", "objective", "losses")
DRAWS = 300
LEAST = 60
"""Recipes that are drawn; how many of them must train, and how many must be refused."""

SIZES = Sizes(batch=1, views=4, image=(16, 24))
WIDTH = 16
HEADS = 2
Choices = dict[str, list[tuple[type[Component], dict[str, Any]]]]


def _choices() -> dict[str, Choices]:
    """By slot and type, the components, with the options of their defaults and examples."""
    found: dict[str, Choices] = {slot: {} for slot in DRAWN}
    for name, installed in registry.load_registry(PLUGINS).plugins.items():
        for case in cases_of(installed):
            kind = f"{name}/{case.component.name}"
            if kind.startswith(KNOWN["only_together"]):
                continue
            if case.slot in found and kind not in KNOWN["not_drawn"]:
                options = case.config.model_dump(mode="json", exclude_unset=True)
                found[case.slot].setdefault(kind, []).append((case.component, options))
    return found


CHOICES = _choices()


def _component(random: Random, slot: str, kind: str) -> dict[str, Any]:
    """A component as a recipe writes it: an example's options, small."""
    component, given = random.choice(CHOICES[slot][kind])
    small = {**KNOWN["small"], **KNOWN["of_kinds"].get(kind, {})}
    of_component = {n: value for n, value in small.items() if n in component.Config.model_fields}
    return {"type": kind, **of_component, **given}


def _drawn(random: Random) -> dict[str, Any]:
    """A recipe with parts of one published model, and some slots filled with anything."""
    published = random.choice(KNOWN["published"])
    wild = random.choice([0.0, 0.05, 0.15, 1.0])
    kinds = {slot: published.get(slot, SLOTS[slot].default) for slot in DRAWN}
    for slot in DRAWN:
        if random.random() < max(wild, 0.2 if slot in ("centers", "losses") else 0.0):
            kinds[slot] = random.choice(list(CHOICES[slot]))
    parts = {slot: _component(random, slot, kind) for slot, kind in kinds.items() if kind}
    if kinds["layer"] != SLOTS["layer"].default and random.random() < 0.9:
        for slot in SUBLAYER_SLOTS:
            del parts[slot]
    depth = random.choice([0, 1, 1, 2])
    decoder = {slot: parts[slot] for slot in LAYER if slot in parts and depth}
    losses = [{"type": "qgs/photometric"}, *([parts["losses"]] if "losses" in parts else [])]
    model = {slot: parts[slot] for slot in ("encoder", "queries", "head", "centers")}
    return {
        "recipe": 1,
        "plugins": PLUGINS,
        "model": {
            **{"width": WIDTH, "heads": HEADS, **model, "decoder": {"depth": depth, **decoder}},
            "supervision": {"layers": [depth]},
            "renderer": {"type": "qgs/torch"},
        },
        "losses": {loss["type"].partition("/")[2]: loss for loss in losses},
        "objective": parts["objective"],
        "views": {"inputs": SIZES.views},
    }


def _train(recipe: Recipe) -> None:
    """One training pass forward and backward, and a prediction."""
    torch.manual_seed(0)
    case = Case(LatentQueries.Config())
    views = Maker(case, SIZES).target()
    times = torch.linspace(0, 1, SIZES.views).expand(SIZES.batch, -1)
    views = replace(views, depths=torch.ones_like(views.images[:, :, :1]))
    inputs = replace(views, times=times, target_time=times[:, :1])
    model = recipe.build_model()
    outcome = TrainingPass(recipe, model.train())(inputs, views.select([1, 2]))
    outcome.total.backward()
    assert outcome.total.isfinite()
    found = [x.grad for x in model.parameters() if x.grad is not None]
    assert found, "nothing gets a gradient"
    assert all(gradient.isfinite().all() for gradient in found)
    with torch.no_grad():
        assert model.eval()(inputs).gaussians.means.isfinite().all()


@pytest.mark.slow
def test_each_product_trains_or_is_refused() -> None:
    trained = list[Recipe]()
    refused = 0
    faults = list[str]()
    for seed in range(DRAWS):
        tree = _drawn(Random(seed))
        try:
            recipe = resolve(tree)
        except RecipeError:
            refused += 1
            continue
        except Exception as error:
            faults.append(f"draw {seed} cannot be composed: {error!r}\n{inline(tree)}")
            continue
        try:
            _train(recipe)
            trained.append(recipe)
        except Exception as error:
            faults.append(f"draw {seed} composes and does not train: {error!r}\n{inline(tree)}")
    assert not faults, "\n\n".join(faults)
    print(f"{len(trained)} train, {refused} are refused")
    assert len(trained) >= LEAST
    assert refused >= LEAST
    parts = [part for recipe in trained for part in recipe.parts.values()]
    used = {(part.component.slot, part.type) for part in parts}
    idle = {(slot, kind) for slot, kinds in CHOICES.items() for kind in kinds} - used
    assert not idle, "no draw trains these"
