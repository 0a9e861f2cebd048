"""Fuzz cases of recipes: shipped recipes with random changes of values, structure or text.

A case passes if the recipe resolves, builds on the device "meta", and resolves to itself again. It
also passes if it is refused with a RecipeError that was not caused by a failure inside a component.
"""

import json
import random
import shutil
from functools import partial
from pathlib import Path
from random import choice, randrange
from typing import Any

from fuzzing.cases import EVERY, RECIPES, TABLES, FaultError, Use, refused
from qgs.contracts import MissingExtraError
from qgs.recipe import PluginError, RecipeError, resolve
from qgs.recipe.recipe import annotated, flat
from qgs.recipe.registry import load_usable_plugins
from qgs.recipe.slots import SLOTS

PARTS = ("finetune/dl3dv", "rooms/budget", "studies/")
"""Prefixes of recipe files that are not complete recipes."""
OPTIONS = {name: flat(resolve(RECIPES / name).tree) for name in EVERY if not name.startswith(PARTS)}
REGISTRY = load_usable_plugins()[0]
TYPES = sorted(kind for slot in SLOTS for kind in REGISTRY.components(slot))
YAML = TABLES["yaml"].splitlines()
YAML += ["9" * 30, "9" * 5000, "x" * 1000, "[" * 80 + "]" * 80, "[" * 3000 + "]" * 3000]


Options = dict[str, Any]
"""Values of a resolved recipe, by dotted path."""
Change = tuple[list[str], str]
"""Change of a recipe: the path of an option, and the YAML text to write there."""


def any_value(options: Options) -> Change:
    """Replace a random option or section by a random YAML text."""
    path = choice([*options]).split(".")
    return path[: choice([None, None, None, None, -1, 1])] or path, choice(YAML)


def scaled(options: Options) -> Change:
    """Multiply a random number: make it larger, smaller, negative or a fraction."""
    path, value = choice([item for item in options.items() if type(item[1]) in (int, float)])
    number = value * choice(TABLES["factors"])
    whole = isinstance(value, int) and random.random() < 0.9
    return path.split("."), str(int(number) if whole else number)


def other_component(options: Options) -> Change:
    """Replace a random component by any component: in the model, in one layer, or by `swap`."""
    path = choice([path for path in options if path.endswith(".type")]).split(".")[:-1]
    layer = ["model", "decoder", "layers", choice(TABLES["layers"]), path[-1]]
    swap = ["swap", choice([".".join(path), f"decoder.layers.*.{path[-1]}", "*", "*.x"])]
    component = f"{{type: {choice(TYPES)}}}"
    return choice((path, layer, swap)), choice((component, component, "null", "{}"))


def elsewhere(options: Options) -> Change:
    """Misspell an option, move it to another section, or change the base recipe."""
    path = choice([*options])
    *section, name = path.split(".")
    others = choice([*options]).split(".")
    value = json.dumps(options[path])
    base = choice([*OPTIONS, *TABLES["bases"]])
    moved = ([*others[:-1], name], value)
    return choice((([*section, name[::-1]], value), moved, (["extends"], base)))


def broken(text: str) -> str:
    """Damage a text: cut it off, remove or repeat a piece, or insert odd characters."""
    pieces = choice((text.splitlines(keepends=True), list(text)))
    first, last = sorted(randrange(len(pieces) + 1) for _ in range(2))
    head = pieces[:first]
    rest = pieces[first:]
    odd = [*head, choice(TABLES["odd"]), *rest]
    return "".join(choice((head, head + pieces[last:], pieces[:last] + rest, odd)))


def judged(text: str, overrides: list[str], file: Path) -> str:
    """Resolve and build a recipe; return "success", or how it was refused.

    Raises an error that no user should see.
    """
    file.write_text(text, "utf-8")
    try:
        recipe = resolve(file, overrides)
        recipe.rate_factors(recipe.build_model("meta"))
    except (RecipeError, MissingExtraError) as error:
        for problem in getattr(error, "problems", ()):
            if problem.cause and not isinstance(problem.cause, PluginError):
                raise FaultError(f"{problem} {problem.cause!r}") from error
        return refused(error)
    file.write_text(annotated(recipe), "utf-8")
    for again in (file, json.loads(json.dumps(recipe.tree))):
        if resolve(again).tree != recipe.tree:
            raise FaultError(f"the recipe changes when it is written and read as {type(again)}")
    return "success"


def case_in(scratch: Path, _: Path) -> tuple[str, Use]:
    """Make a random recipe with one change in its file, and further changes as overrides.

    Returns a description of the case, and the function that uses it.
    """
    name = choice([*OPTIONS])
    shipped = scratch / "recipes" / name
    changes: list[Change] = []
    for _change in range(choice([1, 1, 1, 2, 2, 3, 5])):
        change = choice((any_value, any_value, scaled, other_component, elsewhere))
        changes.append(change(OPTIONS[name]))
    path, value = changes.pop()
    keys = [f"{'  ' * depth}{json.dumps(key)}:" for depth, key in enumerate(path)]
    text = "\n".join(keys) + f" {value}\n"
    if path != ["extends"]:
        text = f"extends: {shipped.name}\n{text}"
    if random.random() < 0.3:
        text = broken(choice((text, shipped.read_text("utf-8"))))
    overrides = [f"{'.'.join(path)}={value}" for path, value in changes]
    shown = f"{name}, {overrides}\n{text[:3000]}"
    return shown, partial(judged, text, overrides, shipped.with_name("case.yaml"))


def prepare(scratch: Path) -> None:
    """Copy the shipped recipes to `scratch`."""
    shutil.copytree(RECIPES, scratch / "recipes")
