"""Recipes drawn from all options of all plugins: each trains, or is refused when it is composed."""

import random
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

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


def _component(random: random.Random, slot: str, kind: str) -> dict[str, Any]:
    """A component as a recipe writes it: an example's options, small, some choices redrawn."""
    component, given = random.choice(CHOICES[slot][kind])
    fields = component.Config.model_fields
    small = dict(KNOWN["small"])
    if kind in KNOWN["blocks"]:
        small["depth"] = KNOWN["blocks"][kind]
    if kind == "tokengs2026/multiscale_vit":
        small |= {"blocks": random.choice([[1, 2], [2]])}
    options = {**{n: value for n, value in small.items() if n in fields}, **given}
    if "memory_width" in options or (slot == "layer" and "memory_width" in fields):
        options["memory_width"] = random.choice([None, 16, 16])  # of globalsplat/patches: 8 + 8
    if options.get("time_channels") is None and "time_channels" in fields:
        options["time_channels"] = random.choice([0, 0, 2])
    if "gaussians_per_query" in options and random.random() < 0.2:
        options["gaussians_per_query"] = random.choice([1, 3, 4])
    given_or_default = component.Config.model_construct(**options)
    for option, field in fields.items():
        is_choice = get_origin(field.annotation) is Literal
        choices = get_args(field.annotation) if is_choice else (True, False)
        for choice in choices if is_choice or field.annotation is bool else ():
            changes = choice != getattr(given_or_default, option)
            if changes and isinstance(choice, bool | str) and random.random() < 0.06:
                options[option] = choice
    return {"type": kind, **options}


def _drawn(random: random.Random) -> dict[str, Any]:
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
    data = {"type": random.choice(["qgs/photos", "datasets/chunks"]), "path": "nowhere"}
    return {
        "recipe": 1,
        "plugins": PLUGINS,
        "model": {
            **{"width": WIDTH, "heads": HEADS, **model, "decoder": {"depth": depth, **decoder}},
            "supervision": {
                "layers": random.choice([[depth], list(range(min(depth, 1), depth + 1))])
            },
            "renderer": {"type": "qgs/torch"},
        },
        "losses": {loss["type"].partition("/")[2]: loss for loss in losses},
        "objective": parts["objective"],
        "views": {"inputs": SIZES.views},
        **(
            {"data": {**data, "image_size": list(SIZES.image or ())}}
            if random.random() < 0.5
            else {}
        ),
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
        tree = _drawn(random.Random(seed))
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
