"""Each distribution requires what it imports, and nothing else.

An installation lends every test all packages, so that only the declarations themselves can tell.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest
from qgs_plugintools.new_command import rendered

import qgs

ROOT = Path(__file__).parents[1]
PLUGINS = (
    "locus",
    "ellipsoid",
    "c3g",
    "gslrm",
    "globalsplat",
    "tokengs2026",
    "rooms",
    "datatools",
    "viewer",
    "studies",
    "refine",
    "bench",
    "plugintools",
)
DISTRIBUTIONS = {
    "PIL": "pillow",
    "qgs": "query-gaussians",
    **{f"qgs_{name}": f"query-gaussians-{name}" for name in PLUGINS},
    "mpl_toolkits": "matplotlib",
    "pydantic_core": "pydantic",
    "skimage": "scikit-image",
    "upath": "universal-pathlib",
    "yaml": "pyyaml",
}
"""Of modules that are not named as theirs, or that another one brings along."""

LOADERS = ("import_module", "find_spec", "importorskip")
BY_OTHERS = {"tensorboard", "wandb", "huggingface-hub"}
"""Imported by accelerate, and by fsspec for hf://."""

OF_DEVELOPMENT = ("docs", "test")
"""Extras whose packages are mostly commands."""

AHEAD = {"a new plugin": {"pydantic"}}
"""For what its author adds first: an option with a `Field`."""

MADE_UP = {"placed-package"}
"""Packages that a test writes for itself."""

FIRST_TO_BE_IMPORTED = ("qgs", "qgs.cli", "qgs.composer.registry", "qgs.engine")


@dataclass(frozen=True)
class Source:
    """Python files of one distribution, by path from its source folder."""

    files: Mapping[str, str]
    project: Mapping[str, Any]

    @property
    def required(self) -> set[str]:
        return set(map(name_of, self.project["dependencies"]))

    def extras(self, *but: str) -> set[str]:
        extras = self.project.get("optional-dependencies", {})
        return {name_of(r) for extra, listed in extras.items() if extra not in but for r in listed}

    def imported(self, module: str) -> dict[str, bool]:
        """Full name of what a file imports, to whether that happens when it is imported itself."""
        return dict(sorted(_imports(ast.parse(self.files[module]), True), key=lambda x: x[1]))

    @property
    def modules(self) -> dict[str, str]:
        """Name of every module to its path."""
        names = (path.removesuffix(".py").removesuffix("/__init__") for path in self.files)
        return dict(zip((name.replace("/", ".") for name in names), self.files, strict=True))

    @property
    def imported_at_once(self) -> dict[str, set[str]]:
        """Name of every module to the full names that it imports when it is imported itself."""
        imported = {module: self.imported(path) for module, path in self.modules.items()}
        return {m: {name for name, now in found.items() if now} for m, found in imported.items()}

    def third_party(self, module: str) -> dict[str, bool]:
        """Distribution of what a file imports of others, to whether that happens at once."""
        own = {path.partition("/")[0].removesuffix(".py") for path in self.files}
        known = sys.stdlib_module_names | own
        found = sorted(self.imported(module).items(), key=lambda x: x[1])
        outermost = [(name.partition(".")[0], at_once) for name, at_once in found]
        return {distribution(name): at_once for name, at_once in outermost if name not in known}


def name_of(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


def distribution(module: str) -> str:
    return DISTRIBUTIONS.get(module, module.replace("_", "-"))


def _imports(node: ast.AST, at_once: bool) -> Iterator[tuple[str, bool]]:
    match node:
        case ast.Import(names=names):
            yield from ((alias.name, at_once) for alias in names)
        case ast.ImportFrom(module=str(module), names=names):
            yield module, at_once
            yield from ((f"{module}.{alias.name}", at_once) for alias in names)
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[given, *_]):
            if name in LOADERS and isinstance(given, ast.Constant):
                yield given.value, False
    lazy = isinstance(node, ast.FunctionDef | ast.Lambda) or (
        isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    )
    for child in ast.iter_child_nodes(node):
        yield from _imports(child, at_once and not lazy)


def source(project: Path, *folders: Path) -> Source:
    files = {
        path.relative_to(folder.parent).as_posix(): path.read_text(encoding="utf-8")
        for folder in folders
        for path in ([folder] if folder.is_file() else folder.rglob("*.py"))
    }
    assert files, folders
    return Source(files, tomllib.loads(project.read_text(encoding="utf-8"))["project"])


def template(part: str) -> Source:
    """The `part`, "src" or "tests", of a new plugin."""
    written = {str(path): text for path, text in rendered("fresh")}
    files = {p.removeprefix(f"{part}/"): t for p, t in written.items() if p.startswith(part)}
    files = {path: text for path, text in files.items() if path.endswith(".py")}
    return Source(files, tomllib.loads(written["pyproject.toml"])["project"])


def plugin(name: str) -> Source:
    folder = ROOT / "plugins" / name
    return source(folder / "pyproject.toml", folder / "src" / f"qgs_{name}")


SOURCES = {
    "query-gaussians": source(ROOT / "pyproject.toml", ROOT / "qgs"),
    **{f"query-gaussians-{name}": plugin(name) for name in PLUGINS},
    "a new plugin": template("src"),
}


@pytest.mark.parametrize("name", SOURCES)
def test_what_is_imported_is_required(name: str) -> None:
    package = SOURCES[name]
    allowed = package.required | package.extras("docs")
    beyond = {m: set(package.third_party(m)) - allowed for m in package.files}
    assert not {module: missing for module, missing in beyond.items() if missing}


@pytest.mark.parametrize("name", SOURCES)
def test_what_is_required_is_imported(name: str) -> None:
    package = SOURCES[name]
    used = {found for module in package.files for found in package.third_party(module)}
    assert package.required - AHEAD.get(name, set()) <= used
    assert package.extras(*OF_DEVELOPMENT) <= used | BY_OTHERS


@pytest.mark.parametrize("name", SOURCES)
def test_an_extra_is_imported_where_it_is_used_alone(name: str) -> None:
    """A module that imports an extra at once, or such a module, is imported by no first one."""
    package = SOURCES[name]
    modules, at_once = package.modules, package.imported_at_once
    needy = {
        module
        for module, path in modules.items()
        if any(now and d not in package.required for d, now in package.third_party(path).items())
    }
    while more := {module for module in modules if at_once[module] & needy} - needy:
        needy |= more
    if name == "query-gaussians":
        assert "qgs.kernels.rasterisation" in needy
        assert not needy & {m for m in modules if m.startswith("qgs.cli")}
        assert not needy & set(FIRST_TO_BE_IMPORTED)
    else:
        assert not needy


def test_no_modules_import_each_other() -> None:
    imported = {m: names for s in SOURCES.values() for m, names in s.imported_at_once.items()}
    graph: dict[str, set[str]] = {}
    for module, names in imported.items():
        homes = {name: name.rpartition(".")[0] for name in names}
        used = {home for name, home in homes.items() if name not in imported}
        graph[module] = used | (names - {*homes.values()})
    TopologicalSorter(graph).prepare()  # raises CycleError with the modules of a circle


def test_the_tests_of_a_new_plugin_require_what_they_import() -> None:
    tests = template("tests")
    used = {found for module in tests.files for found in tests.third_party(module)}
    assert used - tests.required - {"qgs-fresh"} <= tests.extras()
    assert tests.extras() == {"pytest", "query-gaussians-plugintools"}


def test_the_tests_of_qgs_require_what_they_import() -> None:
    folders = [ROOT / "tests", ROOT / "tools", *ROOT.glob("plugins/*/tests")]
    tests = source(ROOT / "pyproject.toml", *folders)
    ours = {Path(path).stem for path in tests.files}
    ours |= {part for path in tests.files for part in Path(path).parts}
    ours = {name.replace("_", "-") for name in ours} | set(SOURCES)
    used = {found for module in tests.files for found in tests.third_party(module)}
    used -= ours | MADE_UP
    assert "pytest" in used
    assert used <= tests.required | tests.extras()


def test_messages_name_the_distributions_of_this_repository() -> None:
    offered: dict[str, dict[str, str]] = {}
    for file in ROOT.glob("plugins/*/pyproject.toml"):
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        for group, entries in project["entry-points"].items():
            offered.setdefault(group, {}).update(dict.fromkeys(entries, project["name"]))
    assert {group: offered[group] for group in qgs.DISTRIBUTIONS} == qgs.DISTRIBUTIONS
