"""The guide says what the code does: its recipes, code, messages, references and tables."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import guide_errors
import guide_reference
import pytest
import torch
import yaml

import qgs
from qgs.cli.new_plugin import rendered
from qgs.composer import RecipeError, resolve
from qgs.composer.registry import load_registry
from qgs.composer.slots import SLOTS
from qgs.contracts import ComponentConfig, ModelDims
from qgs.types import QueryState

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md"))
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)


def text_of(page: str) -> str:
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(page: str, kind: str) -> dict[str, str]:
    """Title, or position, to text of the blocks of one kind."""
    found = BLOCK.findall(text_of(page))
    return {t or str(i): text for i, (k, t, text) in enumerate(found) if k == kind}


def test_messages_are_those_that_are_raised() -> None:
    page = text_of("errors.md")
    assert guide_errors.updated(page) == page, "run `python tools/guide_errors.py`"


def test_quick_start_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(blocks("index.md", "yaml")["mine.yaml"])
    (code,) = blocks("index.md", "python").values()
    names: dict[str, object] = {}
    exec(code, names)
    assert names["means"].shape == (1, 32 * 8, 3)  # type: ignore[attr-defined]
    assert names["image"].shape == (1, 2, 3, 32, 48)  # type: ignore[attr-defined]


def test_code_of_the_five_ideas_runs() -> None:
    names: dict = {}
    for code in blocks("ideas.md", "python").values():
        exec(code, names)
    centers = names["NearCenters"](names["NearCenters"].Config(distance=2.0), ModelDims(16, 2, 1))
    means = centers(torch.zeros(1, 8, 4, 3), QueryState(torch.zeros(1, 8, 16)))
    assert means.tolist() == [[[[0.0, 0.0, 2.0]] * 4] * 8]


def test_recipes_of_the_five_ideas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in blocks("ideas.md", "yaml").items():
        Path(name).write_text(text)
    tree = resolve("recipe.yaml").tree
    layers = tree["model"]["decoder"]["layers"]
    assert layers["0"]["cross_attention"]["type"] == "qgs/content"
    assert tree["model"]["decoder"]["feed_forward"]["ratio"] == 2
    with pytest.raises(RecipeError, match=r"needs anchor\.raw_radius"):
        resolve("refused.yaml")


def test_the_tutorial_shows_what_new_plugin_writes() -> None:
    written = {str(path): text for path, text in rendered("sightline")}
    shown = {
        title: text for title, text in blocks("plugin.md", "python").items() if ":" not in title
    }
    assert shown
    assert {title: written[title] for title in shown} == shown
    assert blocks("plugin.md", "toml").popitem()[1] in written["pyproject.toml"]


def test_the_tutorials_components_and_their_test_are_short() -> None:
    blocks_of = blocks("plugin.md", "python")
    assert len(blocks_of["new: src/qgs_sightline/frustum.py"].splitlines()) < 50
    assert len(blocks_of["src/qgs_sightline/abstaining.py"].splitlines()) < 50
    assert len(blocks_of["change: tests/test_components.py"].splitlines()) < 10


def test_every_reference_to_code_exists() -> None:
    for page in PAGES:
        for name in re.findall(r"\]\[([a-z_]+(?:\.\w+)+)\]", page.read_text(encoding="utf-8")):
            assert _found(name), f"{page.name} refers to {name}"


def _found(name: str) -> bool:
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            thing = import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            thing = getattr(thing, part, None)
        return thing is not None
    return False


def test_every_module_of_the_reference_exists() -> None:
    for page in PAGES:
        for name in re.findall(r"^::: ([\w.]+)", page.read_text(encoding="utf-8"), re.MULTILINE):
            assert _found(name), f"{page.name} documents {name}"


def test_options_named_beside_equations_exist() -> None:
    registry = load_registry(["locus"])
    known = {name for _, config, _ in guide_reference.SECTIONS for name in config.model_fields}
    for slot in SLOTS:
        for component in registry.components(slot).values():
            known |= set(component.Config.model_fields)
    table = text_of("equations.md").split("## Where paper")[0]
    cells = [row.rstrip(" |").rpartition("|")[2] for row in table.splitlines() if "][" in row]
    named = {name.rpartition(".")[2] for cell in cells for name in re.findall(r"`([\w.]+)`", cell)}
    named = {name for name in named if f"[`{name}`]" not in table}
    assert len(named) > 20
    assert named <= known


def _configs() -> dict[str, type[ComponentConfig]]:
    registry = load_registry(guide_reference.PLUGINS)
    sections = {title: config for title, config, _ in guide_reference.SECTIONS}
    components = {
        f"{slot} {name}": component.Config
        for slot in SLOTS
        for name, component in registry.components(slot).items()
    }
    return {**sections, **components}


@pytest.mark.parametrize("name", _configs())
def test_reference_explains_every_option(name: str) -> None:
    config = _configs()[name]
    assert set(config.model_fields) == set(guide_reference.option_meanings(config))
    rows = guide_reference.option_table(config).splitlines()[2:]
    shown = {yaml_cell(row, 0): yaml_cell(row, 2) for row in rows}
    assert set(shown) == set(config.model_fields)
    for option, field in config.model_fields.items():
        if not field.is_required():
            default = field.get_default(call_default_factory=True)
            plain = config.model_construct(**{option: default}).model_dump(mode="json")[option]
            assert yaml.safe_load(shown[option]) == plain, option


def yaml_cell(row: str, index: int) -> str:
    return re.split(r"(?<!\\)\|", row)[1 + index].strip().strip("`")


def test_reference_has_every_slot_and_component() -> None:
    page = guide_reference.reference()
    for slot in SLOTS:
        for name in load_registry(guide_reference.PLUGINS).components(slot):
            assert f"### `{name}` {{ #{slot}-{name.replace('/', '-')} }}" in page


def test_pages_are_in_the_navigation() -> None:
    site = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r": ([\w/]+\.md)$", site, re.MULTILINE))
    assert listed == {str(page.relative_to(DOCS)) for page in PAGES} | {"recipes.md", "checks.md"}


def test_public_names_are_documented() -> None:
    page = text_of("api/qgs.md") + text_of("api/types.md") + text_of("api/contracts.md")
    types = vars(import_module("qgs.types"))
    missing = [n for n in qgs.__all__ if n not in types and f"qgs.{n}" not in page]
    assert missing == ["CONTRACT_VERSION", "Plugin"], "both are on the page of contracts"
