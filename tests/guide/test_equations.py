"""The page of equations: every row leads to code, every option that it names exists."""

from __future__ import annotations

import re

import guide_reference
import pytest
import yaml
from guide_pages import text_of

from qgs.composer.registry import Registry, load_registry
from qgs.composer.slots import SLOTS
from qgs.contracts import Component

EQUATIONS, DIFFERENCES = text_of("equations.md").split("## Where paper and release differ")


@pytest.fixture(scope="module")
def registry() -> Registry:
    return load_registry(guide_reference.PLUGINS)


def components_of(registry: Registry) -> dict[str, list[type[Component]]]:
    found: dict[str, list[type[Component]]] = {}
    for slot in SLOTS:
        for name, component in registry.components(slot).items():
            found.setdefault(name, []).append(component)
    return found


PAPERS = ("qgs/", "locus/")
"""Plugins whose components are those of the papers."""


def rows(text: str, columns: int) -> list[list[str]]:
    """Cells of all rows of all tables, but for their heads."""
    lines = [line for line in text.splitlines() if line.startswith("|") and "---" not in line]
    cells = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    assert all(len(row) == columns for row in cells)
    return [row for row in cells if row[0]]


def test_every_equation_has_its_place_in_the_code() -> None:
    for name, formula, where, _ in rows(EQUATIONS, 4):
        assert formula, name
        assert re.search(r"\]\[qgs\w*\.[\w.]+\]", where), name


def test_options_named_beside_equations_exist(registry: Registry) -> None:
    known = {name for _, config, _ in guide_reference.SECTIONS for name in config.model_fields}
    for components in components_of(registry).values():
        known |= {name for component in components for name in component.Config.model_fields}
    cells = " ".join(row[3] for row in rows(EQUATIONS, 4))
    named = {name.rpartition(".")[2] for name in re.findall(r"`([\w.]+)`", cells)}
    assert len(named) > 30
    assert named <= known


def test_options_that_are_a_papers_form_are_written_as_in_a_recipe(registry: Registry) -> None:
    components = components_of(registry)
    for name, paper, release, cell in rows(DIFFERENCES, 4):
        assert paper != release, name
        option, *kinds = re.findall(r"`([^`]+)`", cell)
        ((key, value),) = yaml.safe_load(f"{{{option}}}").items()
        for kind in kinds:
            (component,) = components[kind]
            chosen = getattr(component.Config(**{key: value}), key)
            assert chosen != component.Config.model_fields[key].get_default(), kind
        having = {
            kind
            for kind, (c, *_) in components.items()
            if kind.startswith(PAPERS) and key in c.Config.model_fields
        }
        assert set(kinds) == having, f"{name}: all components with the option"
