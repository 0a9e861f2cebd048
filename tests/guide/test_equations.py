"""The page of equations: rows lead to code that has their options, constants are the defaults."""

import re
from functools import cache
from pkgutil import resolve_name

import guide
import yaml
from guide_pages import DOCS, all_pages
from tables import rows

from qgs.recipe.errors import Problems
from qgs.recipe.sections import RecipeSettings
from qgs.recipe.slots import SLOTS
from qgs.recipe.yaml_text import load_text

PAGES = all_pages()
EQUATIONS, _, REST = PAGES["equations.md"].partition("## Where paper and release differ")
EQUATIONS += "".join(
    PAGES[f"api/{name}.md"].partition("## Equations")[2]
    for name in ("c3g", "ellipsoid", "globalsplat", "gslrm", "tokengs2026")
)
CONSTANTS = r"""
support radius | radius_min | softplus(ρ), {:g})
bias | bias_min | clamped to [{:g}, 0]
bias | sigma_sq_min | (σ₀ r)² at least {:g}
metric | sigma_sq_min | (σ₀ r)² at least {:g}
PE | features | {:g} features per axis
PE | features | T<sup>2k/{:g}</sup>
PE | temperature | T = {:.0f}
position | input_limit | t clamped to [-{0:g}, {0:g}]
position | output_limit | the result to [-{0:g}, {0:g}]
free means | z_offset | posact(δ) + (0, 0, {:g})
colour, scale, opacity, rotation | scale_cap | c = {:g}
colour, scale, opacity, rotation | scale_input_limit | t clamped to [-{0:g}, {0:g}]
colour, scale, opacity, rotation | opacity_bias | sigmoid(t - {:g})
rendering | dilation | dilation {:g} px²
photometric | ssim_weight | MSE + {:g} (1 - SSIM) / 2
distance | near | (1 - w) · {:g} +
distance | far | w · {:g},
attributes of pixels | scale_bias | exp(min(t - {:g}
attributes of pixels | scale_limit | {:g}))
attributes of pixels | opacity_bias | sigmoid(t - {:g})
visibility | weight | weight {:.1f}
visibility | clamp | at most {:g}
visibility of anchors | weight | weight {:g}
streams | std | N(0, {:g})
round | block_layer_scale | LayerScale {:g}
candidates | scale_bias | log scale + ({:g})
candidates | scale_max | ln {:g} + 2
candidates | opacity_bias | softplus(t + ({:g}))
mean of it | z_offset | t + (0, 0, {:g});
soft frustum | weight | weight {:g}
regularisers | opacity_weight | {:g} mean α
two passes | alpha_weight | {:g} \|A
two passes | depth_weight | {:g} \|D
"""
"""Name of a row, option, how the row's formula gives the option's default."""


def rows_of(text):
    """The cells of the rows of all tables, but for heads, whose first cell is empty."""
    lines = [line for line in text.splitlines() if line.startswith("|") and "---" not in line]
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    assert {len(row) for row in cells} == {4}
    return [row for row in cells if row[0]]


ROWS = rows_of(EQUATIONS)


@cache
def configs(slot):
    return {name: component.Config for name, component in guide.REGISTRY.components(slot).items()}


def owners(option, where):
    """The Configs that have an `option` of a row: a named section's, or its linked classes'.

    What is written at the top of a recipe has neither.
    """
    section, _, name = option.rpartition(".")
    if section:
        places = {t.removeprefix("model."): c for t, c in guide.SECTIONS.items()}
        places |= {s: configs(s)[slot.default] for s, slot in SLOTS.items() if slot.default}
        found = [places[section]]
    else:
        own = (kind.Config for kind in linked(where) if hasattr(kind, "Config"))
        found = [RecipeSettings, *own]
    return [config for config in found if name in config.model_fields]


def linked(cell):
    """What the references to code in a cell lead to."""
    return [resolve_name(name) for name in re.findall(r"\]\[(qgs\w*\.[\w.]+)\]", cell)]


def test_a_row_leads_to_code_that_has_its_options():
    assert len(ROWS) > 70
    for name, formula, where, options in ROWS:
        assert formula, name
        assert linked(where), name
        assert all(owners(option, where) for option in re.findall(r"`([\w.]+)`", options)), name


def test_constants_are_the_defaults():
    for name, option, wording in rows(CONSTANTS):
        found = [row for row in ROWS if row[0] == name and f"`{option}`" in row[3]]
        assert found, (name, option)
        for _, formula, where, _ in found:
            for config in owners(option, where):
                default = config.model_fields[option].get_default()
                assert wording.format(-default if "- {" in wording else default) in formula


def test_defaults_that_are_not_tokengss_are_those_of_its_recipe_taken_back():
    base = yaml.safe_load((DOCS.parent / "recipes/tokengs/base.yaml").read_text())["model"]
    listed = {}
    for _, _, _, cell in rows_of(REST.partition("## Defaults that are not TokenGS's")[2]):
        *options, kind = re.findall(r"`([^`]+)`", cell)
        for option in options:
            ((key, value),) = load_text(option, kind, Problems()).items()
            listed[kind, key] = value
    differing = {}
    for slot in ("head", "centers"):
        kind = base[slot].pop("type")
        fields = configs(slot)[kind].model_fields
        written = base[slot].items()
        differing |= {(kind, key): x for key, x in written if x != fields[key].get_default()}
    assert listed == differing
