"""The page of equations: rows lead to code that has their options, constants are the defaults."""

import re
from functools import cache
from pkgutil import resolve_name
from typing import Any

import guide_reference
import pytest
import yaml
from guide_pages import DOCS, text_of

from qgs.composer import resolve
from qgs.composer.decode import RecipeSettings
from qgs.composer.registry import load_registry
from qgs.composer.slots import SLOTS
from qgs.contracts import Component, ComponentConfig

ROOT = DOCS.parent

EQUATIONS, _, REST = text_of("equations.md").partition("## Where paper and release differ")
DIFFERENCES, _, RELEASES = REST.partition("## Defaults that are not TokenGS's")

ROWS = """
Rays and frames (both papers): Plücker ray of a pixel | ray of a patch | as used for distances |
    world frame | scale of the world | scale of the world, automatic | mirroring
Encoder (TokenGS): images | tokens | block | keys and values |
    several blocks | latents
Decoder layer (TokenGS): queries | cross-attention | self-attention | MLP | residual |
    a time | self-attention, dynamic
Anchors (LocusGS): anchor | support radius | distance to a ray | bias | cross-attention |
    self-attention | PE | refinement | means | means, ablation
Ellipsoidal anchors (in neither paper): anchor | metric | bias |
    the same, in coordinates of the ball | refinement | means | Gaussians in the anchor's frame
Joint attention (C3G): joint layer | Gaussian of a query | mean of it | image tokens
GS-LRM: token of a patch | block of GS-LRM | ray of a Gaussian | distance | means of pixels |
    attributes of pixels
GlobalSplat (its paper; what is ours is in the README of the plugin): token of a patch | streams |
    round | candidates | merging | Gaussians of a token | rotation from 6D |
    soft frustum | regularisers | two passes
Gaussians (both papers): position | free means | colour, scale, opacity, rotation
    | colour along a direction d | rendering
Objective (both papers): photometric | L1, LPIPS | dynamic | visibility | visibility of anchors |
    over layers | weight decay | schedule | token tuning | refinement |
    depth of a pixel | splitting a Gaussian | growing queries
Evaluation: PSNR | SSIM | LPIPS | token dispersion
"""

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


def test_no_row_is_lost() -> None:
    lines = ROWS.strip().replace("\n    ", " ").splitlines()
    wanted = {h: names.split(" | ") for h, _, names in (line.partition(": ") for line in lines)}
    found = {heading: [row[0] for row in rows] for heading, rows in tables(EQUATIONS, 4).items()}
    assert found == wanted


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


def test_powers_of_ten_are_the_defaults() -> None:
    by_name = {row[0]: row[1] for row in EVERY_ROW}
    attention, head = components()["locus/anchor_aware"][0], components()["qgs/gaussian_head"][0]
    assert attention.Config().divisor_eps == 1e-6  # type: ignore[attr-defined]
    assert "T<sup>2k/128</sup> + 10<sup>-6</sup>" in by_name["PE"]
    assert head.Config().quat_eps == 1e-4  # type: ignore[attr-defined]
    assert "max(its length, 10<sup>-4</sup>)" in by_name["colour, scale, opacity, rotation"]


PAPERS = ("qgs/", "locus/")
"""Plugins whose components are those of the papers."""


def test_options_that_are_a_papers_form_are_written_as_in_a_recipe() -> None:
    (rows,) = tables(DIFFERENCES, 4).values()
    (other,) = [row for row in rows if row[3].startswith("the component ")]
    assert other[0] == "free means, in LocusGS's ablation"
    centers = yaml.safe_load(other[3].split("`")[1])
    assert resolve({"recipe": 1, "model": {"centers": centers}}).tree["model"]["centers"] == centers
    assert [row[0] for row in rows if row != other] == [
        "lower bound of r",
        "input of PE",
        "step of a centre",
        "offset δ",
    ]
    for name, paper, release, cell in rows:
        assert paper != release, name
        if name == other[0]:
            continue
        option, *kinds = re.findall(r"`([^`]+)`", cell)
        ((key, value),) = yaml.safe_load(f"{{{option}}}").items()
        for kind in kinds:
            (component,) = components()[kind]
            chosen = getattr(component.Config(**{key: value}), key)
            assert chosen != component.Config.model_fields[key].get_default(), kind
        having = {
            kind
            for kind, (c, *_) in components().items()
            if kind.startswith(PAPERS) and key in c.Config.model_fields
        }
        assert set(kinds) == having, f"{name}: all components with the option"


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
