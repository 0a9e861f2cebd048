"""Resolve mutated recipes, each in a process of its own with limits, and see how each one ends.

    python tools/fuzz_recipes.py --count 1000 [--seed 0] [--only 17]

A case is a shipped recipe in which values, types, structure or text were changed. It passes when it
resolves, builds on "meta" and resolves to itself again, or when it is refused by one RecipeError
of which no problem comes from a component that fails inside.
"""

import json
import random
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from fuzzing import FaultError, Use, fuzz, refused

from qgs.contracts import MissingExtraError
from qgs.recipe import PluginError, RecipeError, resolve
from qgs.recipe.recipe import annotated, flat
from qgs.recipe.registry import load_usable_plugins
from qgs.recipe.slots import SLOTS

RECIPES = Path(__file__).parents[1] / "recipes"
RAW = (
    "0", "1", "-1", "1.5", "1e400", "-1e308", ".nan", "-.inf", "1e-4", "100000", "65536", "0x7f",
    "1_000", "1:30", "true", "null", "~", "yes", "off", "''", "é", "../../..", "os.system", "qgs/",
    "[]", "{}", "[1]", "[1, 2, 3]", "[[1, 2], [3]]", "[null]", "{a: 1}", "{type: qgs/latent}",
    "{type: null}", "{type: 3}", "{kind: x}", "{1: 2}", "{[a]: 1}", "&z [*z]", "*nowhere", "!x 1",
    "!!python/object/apply:os.system [ls]", "!!int x", "{<<: {a: 1}}", "{a: 1, a: 2}", "'open",
    "[open", "a: b", "@at", "{schedule: x}", "{schedule: linear, values: [1, 2], at: [0, 9]}",
    "9" * 30, "9" * 5000, "x" * 1000, "[" * 80 + "]" * 80, "[" * 3000 + "]" * 3000,
)  # fmt: skip
"""YAML in place of an option's."""


FOUND = [path.relative_to(RECIPES).as_posix() for path in sorted(RECIPES.rglob("*.yaml"))]
OVERLAYS = ("finetune/dl3dv", "rooms/budget", "studies/")
NAMES = [name for name in FOUND if not name.startswith(OVERLAYS)]
WRITTEN = {name: yaml.safe_load((RECIPES / name).read_text(encoding="utf-8")) for name in NAMES}
OPTIONS = {name: flat(resolve(RECIPES / name).tree) for name in NAMES}
REGISTRY, _ = load_usable_plugins()
TYPES = sorted(kind for slot in SLOTS for kind in REGISTRY.components(slot))


@dataclass
class Case:
    """A mutated recipe. raw: by mark, the YAML that replaces it in the text."""

    name: str
    tree: dict[str, Any]
    dice: random.Random
    raw: dict[str, str] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)

    def path(self) -> list[str]:
        """The path of an option, or of a mapping, of the resolved recipe."""
        path = self.dice.choice(list(OPTIONS[self.name])).split(".")
        return path[: self.dice.choice([len(path)] * 4 + [max(1, len(path) - 1), 1])]

    def put(self, path: list[str], value: Any) -> None:
        """Write `value` at `path`, making mappings on the way."""
        node: Any = self.tree
        for key in path[:-1]:
            node[key] = node[key] if isinstance(node.get(key), dict) else {}
            node = node[key]
        node[path[-1]] = value


def any_value(case: Case) -> None:
    """Any text in place of an option, in the file or on the command line."""
    text, mark = case.dice.choice(RAW), f"MARK{len(case.raw)}X"
    if case.dice.random() < 0.4:
        case.overrides.append(f"{'.'.join(case.path())}={text}")
    else:
        case.raw[mark] = text
        case.put(case.path(), mark)


def scaled(case: Case) -> None:
    """A number made larger, smaller, negative or a fraction, with its neighbours kept."""
    values = OPTIONS[case.name]
    numbers = [k for k, v in values.items() if isinstance(v, int | float) and type(v) is not bool]
    key = case.dice.choice(numbers)
    value = values[key] * case.dice.choice((-1, 0, 2, 3, 0.5, 1e-9, 10, 100, 1e4))
    whole = isinstance(values[key], int) and case.dice.random() < 0.9
    case.put(key.split("."), int(value) if whole else value)


def other_component(case: Case) -> None:
    """Any component in place of another, with its options or without, of layers too."""
    values = OPTIONS[case.name]
    path = case.dice.choice([k for k in values if k.endswith(".type")]).split(".")
    kind = case.dice.choice(TYPES)
    layer = case.dice.choice(["0", "1", "-1", "99", "*", ""])
    patterns = (".".join(path[:-1]), f"decoder.layers.*.{path[-2]}", "*", "[!a]*", "*.x")
    alone = (path[:-1], ["model", "decoder", "layers", layer, path[-2]])
    if case.dice.random() < 0.5:
        case.put(path, kind)
    elif case.dice.random() < 0.6:
        case.put(case.dice.choice(alone), {"type": kind})
    else:
        case.put(["swap", case.dice.choice(patterns)], case.dice.choice([{"type": kind}, None, {}]))


def structure(case: Case) -> None:
    """A key left out, misspelt, moved elsewhere or made a list; another base, another plugin."""
    path = case.path()
    node: Any = case.tree
    for key in path[:-1]:
        node = node.get(key) if isinstance(node, dict) else None
    value = node.pop(path[-1], None) if isinstance(node, dict) else None
    where = case.dice.choice([None, [*path[:-1], path[-1][::-1]], case.path(), ["extends"], path])
    if where == ["extends"]:
        bases = [*NAMES, "absent.yaml", ".", "", "case.yaml", 3, None, ["case.yaml"], {"a": "b"}]
        value = case.dice.choice(bases)
    if where:
        case.put(where, value if where != path else [value] * case.dice.choice([1, 2, 30]))


def broken(text: str, dice: random.Random) -> str:
    """The text cut, a piece of it repeated, or characters put into it."""
    a, b = sorted(dice.randrange(len(text) + 1) for _ in range(2))
    odd = dice.choice([*"\t\0\u2028\r\ufeff:|>[{}'\"#\n", "- ", "? ", "&a ", "*a ", "!!", "---\n"])
    pieces = (text[:a], text[:a] + text[b:], text[:b] + text[a:], text[:a] + odd + text[a:])
    return dice.choice(pieces)


def judged(case: Case, text: str, file: Path) -> str:
    """How `case` ends. Raises what nobody should see."""
    file.write_text(text, encoding="utf-8")
    try:
        recipe = resolve(file, case.overrides)
        recipe.rate_factors(recipe.build_model("meta"))
    except (RecipeError, MissingExtraError) as error:
        for problem in getattr(error, "problems", ()):
            if problem.cause and not isinstance(problem.cause, PluginError):
                raise FaultError(f"{problem} {problem.cause!r}") from error
        return refused(error)
    file.write_text(annotated(recipe), encoding="utf-8")
    for again in (file, json.loads(json.dumps(recipe.tree))):
        if resolve(again).tree != recipe.tree:
            raise FaultError(f"resolves to another recipe when it is written as {type(again)}")
    return "success"


def prepared(scratch: Path) -> Callable[[random.Random, Path], tuple[str, Use]]:
    """Cases are made in a copy of the recipes."""
    folder = scratch / "recipes"
    shutil.copytree(RECIPES, folder)

    def case_in(dice: random.Random, own: Path) -> tuple[str, Use]:
        name = dice.choice(NAMES)
        case = Case(name, json.loads(json.dumps(WRITTEN[name])), dice)
        for _ in range(dice.choice([1, 1, 1, 2, 2, 3, 5])):
            dice.choice((any_value, any_value, scaled, other_component, structure))(case)
        text = yaml.safe_dump(case.tree, sort_keys=False, width=10_000)
        for mark, yaml_text in case.raw.items():
            text = text.replace(mark, yaml_text)
        text = broken(text, dice) if dice.random() < 0.2 else text
        shown = f"{name}, {case.overrides}\n{text[:3000]}"
        return shown, partial(judged, case, text, (folder / name).with_name("case.yaml"))

    return case_in


if __name__ == "__main__":
    sys.exit(fuzz(__doc__, prepared))
