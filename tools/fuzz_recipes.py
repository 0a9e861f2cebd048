"""Resolve mutated recipes, each in a process of its own with limits, and see how each one ends.

    python tools/fuzz_recipes.py --count 1000 --seed 0
    python tools/fuzz_recipes.py --seed 0 --only 17       # one again, with its recipe and its end

A case is a shipped recipe in which values, types, structure, files or text were changed. It passes
when it resolves, builds on "meta" and resolves to itself again, or when it is refused by one
RecipeError that names a place, within the limits of fuzzing.py, with a short message.
"""

import json
import os
import random
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from fuzzing import FaultError, Use, fuzz, refused

from qgs.analysis.shown import parameter_counts
from qgs.composer import PluginError, Recipe, RecipeError, resolve
from qgs.composer.recipe import annotated, differing_options, flat
from qgs.composer.registry import load_sound_plugins
from qgs.composer.slots import SLOTS
from qgs.contracts import MissingExtraError

RECIPES = Path(__file__).parents[1] / "recipes"

BOMB = "[&a [1,1,1,1,1,1,1,1,1], " + ", ".join(
    f"&{b} [{','.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefg", "bcdefgh", strict=True)
)
RAW = (
    *("0", "1", "-1", "-0", "1.5", "1e-400", "1e400", "-1e308", ".nan", ".inf", "-.inf", "1e-4"),
    *("9223372036854775807", "9223372036854775808", "1e9", "100000000", "65536", "4096", "0x7f"),
    *("9" * 400, "9" * 5000, "-" + "9" * 400, "1." + "9" * 5000, "0o777", "0b11", "1_000", "1:30"),
    *("true", "false", "null", "~", "yes", "off", "''", '" "', '"\\0"', '"a\\0b"', '"\\ud800"'),
    *('"\\e[31m"', '"\\u202e"', '"\\x85\\u2028"', "é", '"\\U0001F600"', "../../..", "/dev/zero"),
    *("x" * 1000, '"' + "y" * 60_000 + '"', '"' + "a.b" * 2000 + '"', "os.system", "qgs/", "/"),
    *("[]", "{}", "[1]", "[1, 2, 3]", "[[1, 2], [3]]", "[null]", "[a, a]", "{a: 1}", "{'': 1}"),
    *("{type: qgs/latent}", "{type: null}", "{type: 3}", "{kind: x}", "{1: 2}", "{[a]: 1}"),
    *("[" * 40 + "]" * 40, "[" * 3000 + "]" * 3000, "{a: " * 60 + "1" + "}" * 60, "[" * 900),
    *("[" + "1, " * 5000 + "1]", "[" + "x, " * 19_000 + "1]", "[" + "0.1, " * 30_000 + "1]"),
    *("{" + ", ".join(f"k{n}: 1" for n in range(9000)) + "}", BOMB + "]", "&z [*z]", "*nowhere"),
    *("!!python/object/apply:os.system [ls]", "!!binary aGk=", "!!set {a, b}", "!!int x", "!x 1"),
    *("!!float '1'", "!!str 1", "!!timestamp 2001-01-01", "{<<: {a: 1}}", "{a: 1, a: 2}", "? a"),
    *(
        "|\n  text",
        ">-\n  folded",
        "@at",
        "`tick",
        "%x",
        "'open",
        '"open',
        "[open",
        "{open",
        "a: b",
    ),
    *("&a {<<: *a}", "{<<: [&b {x: 1}, *b], y: *b}", "{&c a: *c}", "{<<: 1}", "{? {a: 1} : 1}"),
    *("!!python/name:os.system", "!!map [1]", "!!seq {a: 1}", "!!omap [a: 1]", "!!null x", "0o"),
    *("1e99999999", "-.nan", "0x" + "f" * 300, "0b" + "1" * 2000, "1__0", "0.0e+0", "+.inf", "١"),
)
EXTENDS = (
    *("/dev/zero", "/dev/stdin", "/proc/self/mem", "/etc/passwd", "/", ".", "..", "''", "fifo"),
    *("loop", "chain0.yaml", "diamond0.yaml", "binary", "empty", "bom.yaml", "latin.yaml", "huge"),
    *('"a\\0b"', '"a\\ud800"', "x" * 5000, "absent.yaml", "link.yaml", "many.yaml", "list.yaml"),
    *("[]", "[[a]]", "{a: b}", "3", "[null]", "[chain900.yaml, wide.yaml]", "wide.yaml", "~/x"),
    *("utf16.yaml", "anchors.yaml", "https://127.0.0.1:9/x", "file:///etc/passwd", "memory://x"),
)


@cache
def base(name: str) -> tuple[dict[str, Any], Recipe]:
    """A shipped recipe as it is written, and resolved."""
    written = yaml.safe_load((RECIPES / name).read_text(encoding="utf-8"))
    return written, resolve(RECIPES / name)


@cache
def names() -> list[str]:
    """The shipped recipes that resolve alone."""
    files = sorted({*RECIPES.rglob("*.yaml")} - {*RECIPES.glob("studies/**/*.yaml")})
    found = [path.relative_to(RECIPES).as_posix() for path in files]
    return [name for name in found if not name.startswith(("finetune/dl3dv", "rooms/budget"))]


@cache
def types() -> list[str]:
    """Names of all components of all slots."""
    registry, _ = load_sound_plugins()
    return sorted(kind for slot in SLOTS for kind in registry.components(slot))


@dataclass
class Case:
    """A mutated recipe. raw: YAML in place of a string of its tree. text: what is changed last."""

    name: str
    tree: dict[Any, Any]
    random: random.Random
    raw: dict[str, str] = field(default_factory=dict)
    text: list[Callable[[str], str]] = field(default_factory=list)
    overrides: list[str] = field(default_factory=list)
    mapping: bool = False
    encoding: str = "utf-8"

    def as_is(self, yaml_text: str) -> str:
        """A mark in place of which `yaml_text` is written."""
        mark = f"MARK{len(self.raw)}X"
        self.raw[mark] = yaml_text
        return mark

    def written(self) -> str:
        """The recipe as text."""
        text = yaml.safe_dump(self.tree, sort_keys=False, width=10_000, default_flow_style=False)
        for mark, yaml_text in self.raw.items():
            text = text.replace(mark, yaml_text)
        for change in self.text:
            text = change(text)
        return text

    def bytes(self) -> bytes:
        """The file."""
        how = "surrogatepass" if self.encoding.startswith("utf") else "replace"
        return self.written().encode(self.encoding, how)

    def path(self) -> tuple[str, ...]:
        """The path of any option or mapping of the resolved recipe."""
        path = tuple(self.random.choice(list(flat(base(self.name)[1].tree))).split("."))
        return path[: self.random.choice([len(path)] * 4 + [max(1, len(path) - 1), 1])]

    def put(self, path: Sequence[str], value: Any) -> None:
        """Write `value` at `path`, making mappings on the way."""
        node: Any = self.tree
        for key in path[:-1]:
            if not isinstance(node.get(key), dict):
                node[key] = {}
            node = node[key]
        node[path[-1]] = value


def any_value(case: Case) -> None:
    """Any text in place of any option."""
    case.put(case.path(), case.as_is(case.random.choice(RAW)))


def any_override(case: Case) -> None:
    """Any text given to any option, or to a path that there is not, on the command line."""
    path, value = ".".join(case.path()), case.random.choice(RAW)
    odd = ("", ".", "a" * 3000, ".".join("a" * 300), "extends", "swap.x", "\0", "\ud800", "a..b")
    path = case.random.choice([path] * 8 + list(odd))
    case.overrides.append(case.random.choice([f"{path}={value}"] * 9 + [path, f"={value}"]))


def scaled(case: Case) -> None:
    """A number made larger, smaller, negative or a fraction, with its neighbours kept."""
    values = flat(base(case.name)[1].tree)
    numbers = [k for k, v in values.items() if isinstance(v, int | float) and type(v) is not bool]
    key = case.random.choice(numbers)
    factors = (-1, 0, 2, 3, 0.5, 1e-9, 10, 100, 1e4, 1e6, 1e9, 1e30, 1e308)
    value = values[key] * case.random.choice(factors)
    whole = isinstance(values[key], int) and abs(value) < 1e300 and case.random.random() < 0.9
    case.put(key.split("."), int(value) if whole else value)


def other_type(case: Case) -> None:
    """Any component in place of another, mostly with the options that stood there."""
    values = flat(base(case.name)[1].tree)
    path = case.random.choice([k for k in values if k.endswith(".type")]).split(".")
    kind, alone = case.random.choice(types()), case.random.random() < 0.5
    case.put(path[:-1] if alone else path, {"type": kind} if alone else kind)


def layers_and_swaps(case: Case) -> None:
    """Layers of their own and patterns, among them such as match nothing, all or twice."""
    slots = ("cross_attention", "self_attention", "feed_forward", "refinement", "x", "*", "")
    slot, kind = case.random.choice(slots), {"type": case.random.choice(types())}
    layer = case.random.choice(["0", "1", "5", "-1", "99", "*", "[0-9]", "[", "?", "1e3", "", "01"])
    if case.random.random() < 0.5:
        case.put(("model", "decoder", "layers", layer, slot), case.random.choice([kind, {}, None]))
        return
    patterns = (f"decoder.layers.{layer}.{slot}", f"*.{slot}", "*", "**", "[!a]*", "*a" * 40)
    case.put(("swap", case.random.choice(patterns)), case.random.choice([kind, None, [], {}]))


def structure(case: Case) -> None:
    """A key left out, misspelt, moved elsewhere or made a list."""
    path = case.path()
    node: Any = case.tree
    for key in path[:-1]:
        node = node.get(key) if isinstance(node, dict) else None
    value = node.pop(path[-1], None) if isinstance(node, dict) else None
    how = case.random.randrange(5)
    if how == 1:
        case.put((*path[:-1], path[-1][::-1]), value)
    elif how == 2:
        case.put(case.path(), value)
    elif how == 3:
        case.put(path, [value] * case.random.choice([1, 2, 500]))
    elif how == 4:
        case.put((*path, *case.path()), value)


def odd_files(case: Case) -> None:
    """`extends` of what is no recipe, or too much of one."""
    some = [case.random.choice(EXTENDS) for _ in range(case.random.choice([1, 1, 1, 2, 3]))]
    one = some[0] if len(some) == 1 else f"[{', '.join(some)}]"
    case.tree["extends"] = case.as_is(one)


def sections(case: Case) -> None:
    """Names of losses, metrics, plugins and parts of the optimiser, none of them or very many."""
    count = case.random.choice([0, 1, 3, 100, 3000])
    kinds = case.random.choices(types(), k=5)
    which = case.random.choice(["losses", "metrics", "plugins", "optimizer", "data"])
    many = {f"n{n}": case.random.choice([{"type": kinds[n % 5]}, None]) for n in range(count)}
    if which == "plugins":
        names = ["locus", "rooms", "ellipsoid", "globalsplat", "qgs", "none", "../x", "a" * 500]
        known = [*names, 3, None]
        case.tree["plugins"] = [case.random.choice(known) for _ in range(min(count, 300))]
    elif which == "optimizer":
        patterns = ["*", "model.*", "encoder", "losses.*", "[", "x", "decoder.layers.*.*", "*" * 90]
        parts = {case.random.choice(patterns) + "?" * (n % 50): 0.1 * n for n in range(count)}
        case.put(("optimizer", "parts"), parts)
    else:
        case.tree[which] = case.random.choice([many, [], None, "x", {None: None}, {"": {}}])


def broken_text(case: Case) -> None:
    """The text cut, a piece of it repeated, or characters put into it."""
    seed = case.random.random()
    odd = [*"\t\0\ud800\u2028\x85\r\ufeff:|>[{}'\"#\n", "- ", "? ", "&a ", "*a ", "  ", "!!"]
    odd += ["---\n", "...\n", "%YAML 9.9\n", "<<: "]

    def change(text: str) -> str:
        draw = random.Random(seed)  # the same however often it is written
        a, b = sorted(draw.randrange(len(text) + 1) for _ in range(2))
        how = draw.randrange(6)
        if how == 0:
            return text[:a]
        if how == 1:
            return text[:a] + text[b:]
        if how == 2:
            return text[:a] + text[a:b] * draw.choice([2, 10, 3000]) + text[b:]
        if how == 3:
            return text[:a] + draw.choice(odd) * draw.choice([1, 1, 2, 500]) + text[a:]
        lines = text.splitlines(keepends=True)
        place = draw.randrange(len(lines) + 1)
        line = draw.choice([*lines[place : place + 1], "extends: []\n", "<<: {seed: 1}\n"])
        if how == 4:  # the same key twice
            return "".join([*lines[:place], line, *lines[place:]])
        indented = line.replace("  ", draw.choice(["\t", " ", "   ", ""]), 1)
        return "".join([*lines[:place], indented, *lines[place + 1 :]])

    case.text.append(change)


def other_encoding(case: Case) -> None:
    """The text in bytes of another encoding."""
    case.encoding = case.random.choice(["utf-16", "utf-16-be", "utf-32", "utf-8-sig", "cp500"])


def python_value(case: Case) -> None:
    """The recipe as a Python mapping that holds what YAML never would."""
    deep: Any = {}
    for _ in range(case.random.choice([10, 70, 990, 5000])):
        deep = case.random.choice([{"a": deep}, [deep]])
    knot: dict[str, Any] = {}
    knot["k"] = knot
    odd = [
        *(10**400, -(10**5000), b"x", {1, 2}, object(), 1j, "\ud800", "a\0", range(9)),
        *(deep, knot, (1, 2), Path("x"), Path("a\0b"), {3: 4}, {None: 1}, ["x"] * 30_000),
        *(np.float32(1), np.array([1.0, 2]), np.int64(3), torch.ones(2), True, Decimal("1"), print),
    ]
    case.mapping = True
    case.put(case.path(), case.random.choice(odd))


MUTATIONS = (
    *(any_value, any_value, any_value, any_override, any_override, scaled, scaled, scaled),
    *(other_type, other_type, layers_and_swaps, structure, odd_files, sections),
    *(broken_text, broken_text, python_value, other_encoding),
)


def made(draw: random.Random) -> Case:
    """A case: always the same of equal dice."""
    name = draw.choice(names())
    tree = json.loads(json.dumps(base(name)[0]))
    case = Case(name, tree, draw)
    for _ in range(draw.choice([1, 1, 1, 2, 2, 3, 5])):
        draw.choice(MUTATIONS)(case)
    return case


def odd_folder(folder: Path) -> None:
    """Put the files of EXTENDS into `folder`."""
    os.mkfifo(folder / "fifo")
    (folder / "loop").symlink_to("loop2")
    (folder / "loop2").symlink_to("loop")
    (folder / "link.yaml").symlink_to("diamond17.yaml")
    texts = {"empty": b"", "binary": bytes(range(256)) * 40, "latin.yaml": b"recipe: 1 # \xe9\n"}
    texts["bom.yaml"] = "\ufeffrecipe: 1\n".encode()
    texts["utf16.yaml"] = "recipe: 1\n".encode("utf-16")
    texts["anchors.yaml"] = b"recipe: 1\nmodel: &m {<<: *m}\n"
    texts["many.yaml"] = f"extends: [{'link.yaml, ' * 3000}link.yaml]\n".encode()
    texts["list.yaml"] = f"extends: [{'empty, ' * 30}bom.yaml]\n".encode()
    wide = [f"part{n}.yaml" for n in range(60)]
    texts["wide.yaml"] = f"extends: [{', '.join(wide)}]\n".encode()
    options = ", ".join(f"k{n}: {n}" for n in range(300))
    texts |= dict.fromkeys(wide, f"model: {{queries: {{{options}}}}}\n".encode())
    for n in range(1000):
        texts[f"chain{n}.yaml"] = f"recipe: 1\nextends: chain{n + 1}.yaml\n".encode()
    for n in range(18):
        texts[f"diamond{n}.yaml"] = (
            f"extends: [diamond{n + 1}.yaml, ./diamond{n + 1}.yaml]".encode()
        )
    texts["diamond18.yaml"] = b"recipe: 1\n"
    for name, text in texts.items():
        (folder / name).write_bytes(text)
    with (folder / "huge").open("wb") as file:
        file.truncate(10**12)


def judged(case: Case, folder: Path) -> str:
    """How `case` ends. Raises what nobody should see."""
    path = (folder / case.name).with_name("case.yaml")
    try:
        if case.mapping:
            recipe = resolve(case.tree, case.overrides)
        else:
            path.write_bytes(case.bytes())
            recipe = resolve(path, case.overrides)
        model = recipe.build_model("meta")
        recipe.rate_factors(model)
        recipe.build_losses()
        recipe.build_metrics()
    except RecipeError as error:
        refuse_faulty(error)
        return refused(error)
    except MissingExtraError as error:
        return refused(error)
    parameter_counts(model)
    differing_options(base(case.name)[1].tree, recipe.tree)
    texts = {"JSON": json.dumps(recipe.tree), "YAML": annotated(recipe)}
    for kind, text in texts.items():
        path.write_bytes(text.encode())
        again = resolve(json.loads(text) if kind == "JSON" else path)
        if again.tree != recipe.tree:
            raise FaultError(f"resolves to another recipe when it is written as {kind}")
    return "success"


def refuse_faulty(error: RecipeError) -> None:
    """Raise FaultError for a problem without a place, or one of a component that failed inside."""
    for problem in error.problems:
        if problem.cause and not isinstance(problem.cause, PluginError):
            raise FaultError("".join(traceback.format_exception(problem.cause)))
        if not problem.file:
            raise FaultError(f"a problem without a place: {problem}")


def prepared(scratch: Path) -> Callable[[random.Random, Path], tuple[str, Use]]:
    """Resolve all that cases begin with; make them in a copy of the recipes with odd files."""
    types()
    for name in names():
        base(name)
    folder = scratch / "recipes"
    shutil.copytree(RECIPES, folder)
    for inside in [folder, *(path for path in folder.iterdir() if path.is_dir())]:
        odd_folder(inside)

    def case_in(dice: random.Random, _: Path) -> tuple[str, Use]:
        case = made(dice)
        what = "a mapping" if case.mapping else case.written()[:3000]
        shown = f"{case.name}, {[text[:300] for text in case.overrides]}\n{what!s}"
        return shown.encode(errors="replace").decode(), partial(judged, case, folder)

    return case_in


if __name__ == "__main__":
    sys.exit(fuzz(__doc__, prepared))
