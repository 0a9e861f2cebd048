"""The page of equations: rows lead to code that has their options, constants are the defaults."""

import re
from functools import cache
from pkgutil import resolve_name
from typing import Any

import guide_reference
import pytest
import yaml
from guide_pages import DOCS, all_pages

from qgs.composer.decode import RecipeSettings
from qgs.composer.registry import load_registry
from qgs.composer.slots import SLOTS
from qgs.contracts import Component, ComponentConfig

ROOT = DOCS.parent

EQUATIONS, _, REST = all_pages()["equations.md"].partition("## Where paper and release differ")
DIFFERENCES, _, RELEASES = REST.partition("## Defaults that are not TokenGS's")


CONSTANTS = [
    ("support radius", "radius_min", "softplus(ρ), {:g})"),
    ("bias", "bias_min", "clamped to [{:g}, 0]"),
    ("bias", "sigma_sq_min", "(σ₀ r)² at least {:g}"),
    ("metric", "sigma_sq_min", "(σ₀ r)² at least {:g}"),
    ("PE", "features", "{:g} features per axis"),
    ("PE", "features", "T<sup>2k/{:g}</sup>"),
    ("PE", "temperature", "T = {:.0f}"),
    ("position", "input_limit", "t clamped to [-{0:g}, {0:g}]"),
    ("position", "output_limit", "the result to [-{0:g}, {0:g}]"),
    ("free means", "z_offset", "posact(δ) + (0, 0, {:g})"),
    ("colour, scale, opacity, rotation", "scale_cap", "c = {:g}"),
    ("colour, scale, opacity, rotation", "scale_input_limit", "t clamped to [-{0:g}, {0:g}]"),
    ("colour, scale, opacity, rotation", "opacity_bias", "sigmoid(t - {:g})"),
    ("rendering", "dilation", "dilation {:g} px²"),
    ("photometric", "ssim_weight", "MSE + {:g} (1 - SSIM) / 2"),
    ("distance", "near", "(1 - w) · {:g} +"),
    ("distance", "far", "w · {:g},"),
    ("attributes of pixels", "scale_bias", "exp(min(t - {:g}"),
    ("attributes of pixels", "scale_limit", "{:g}))"),
    ("attributes of pixels", "opacity_bias", "sigmoid(t - {:g})"),
    ("visibility", "weight", "weight {:.1f}"),
    ("visibility", "clamp", "at most {:g}"),
    ("visibility of anchors", "weight", "weight {:g}"),
    ("streams", "std", "N(0, {:g})"),
    ("round", "block_layer_scale", "LayerScale {:g}"),
    ("candidates", "scale_bias", "log scale + ({:g})"),
    ("candidates", "scale_max", "ln {:g} + 2"),
    ("candidates", "opacity_bias", "softplus(t + ({:g}))"),
    ("mean of it", "z_offset", "t + (0, 0, {:g});"),
    ("soft frustum", "weight", "weight {:g}"),
    ("regularisers", "opacity_weight", "{:g} mean α"),
    ("two passes", "alpha_weight", "{:g} \\|A"),
    ("two passes", "depth_weight", "{:g} \\|D"),
]
"""Name of a row, option, how the row's formula gives the option's default."""


def tables(text: str, columns: int) -> dict[str, list[list[str]]]:
    """Heading to the cells of the rows of its table, but for the table's head."""
    found: dict[str, list[list[str]]] = {}
    heading = ""
    for line in text.splitlines():
        heading = line.removeprefix("## ") if line.startswith("## ") else heading
        if line.startswith("|") and "---" not in line:
            row = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            assert len(row) == columns
            if row[0]:
                found.setdefault(heading, []).append(row)
    return found


EVERY_ROW = [row for rows in tables(EQUATIONS, 4).values() for row in rows]


@cache
def components() -> dict[str, list[type[Component]]]:
    registry = load_registry(guide_reference.PLUGINS)
    found: dict[str, list[type[Component]]] = {}
    for slot in SLOTS:
        for name, component in registry.components(slot).items():
            found.setdefault(name, []).append(component)
    return found


def linked(cell: str) -> list[Any]:
    """What the references to code in a cell lead to."""
    names = re.findall(r"\]\[(qgs\w*\.[\w.]+)\]", cell)
    return [resolve_name(name) for name in names]


def owners(option: str, where: str) -> list[type[ComponentConfig]]:
    """The Configs that have an `option` of a row: a named section's, or its linked classes'.

    What is written at the top of a recipe has neither.
    """
    section, _, name = option.rpartition(".")
    if section:
        places = {t.removeprefix("model."): c for t, c in guide_reference.SECTIONS.items()}
        defaults = {name: slot.default for name, slot in SLOTS.items() if slot.default}
        places |= {name: components()[kind][0].Config for name, kind in defaults.items()}
        return [places[section]]
    if name in RecipeSettings.model_fields:
        return [RecipeSettings]
    return [
        thing.Config
        for thing in linked(where)
        if isinstance(thing, type) and issubclass(thing, Component)
        if name in thing.Config.model_fields
    ]


@pytest.mark.parametrize("row", EVERY_ROW, ids=lambda row: row[0])
def test_a_row_leads_to_code_that_has_its_options(row: list[str]) -> None:
    name, formula, where, cell = row
    assert formula, name
    assert linked(where), name
    for option in re.findall(r"`([\w.]+)`", cell):
        configs = owners(option, where)
        assert configs, f"no class that is linked has the option {option}"
        assert all(option.rpartition(".")[2] in config.model_fields for config in configs)


@pytest.mark.parametrize(("name", "option", "wording"), CONSTANTS)
def test_constants_are_the_defaults(name: str, option: str, wording: str) -> None:
    found = [row for row in EVERY_ROW if row[0] == name and f"`{option}`" in row[3]]
    assert found
    for _, formula, where, _ in found:
        for config in owners(option, where):
            default = config.model_fields[option].get_default()
            shown = wording.format(-default if "- {" in wording else default)
            assert shown in formula


def test_defaults_that_are_not_tokengss_are_those_of_its_recipe_taken_back() -> None:
    base = yaml.safe_load((ROOT / "recipes/tokengs/base.yaml").read_text("utf-8"))
    (rows,) = tables(RELEASES, 4).values()
    listed = set()
    for _, _, _, cell in rows:
        *options, kind = re.findall(r"`([^`]+)`", cell)
        (component,) = components()[kind]
        (place,) = [p for p in base["model"].values() if isinstance(p, dict) and kind in p.values()]
        for option in options:
            ((key, value),) = yaml.safe_load(f"{{{option}}}").items()
            value = float(value) if value is not None else None
            written = place[key]
            assert (float(written) if written is not None else None) == value
            assert component.Config.model_fields[key].get_default() != value
            listed.add((kind, key))
    differing = {
        (place["type"], key)
        for place in (base["model"]["head"], base["model"]["centers"])
        for key, value in place.items()
        if key != "type"
        if components()[place["type"]][0].Config.model_fields[key].get_default() != value
    }
    assert listed == differing
