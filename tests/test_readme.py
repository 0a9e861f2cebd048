"""What the README and the pages that it leads to show is what the repository holds."""

import re
from importlib.metadata import entry_points
from pathlib import Path

import yaml

from qgs.cli import COMMANDS
from qgs.cli.plugin_commands import GROUP
from qgs.composer.slots import SECTIONS, SLOTS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def test_overlay_is_the_recipe() -> None:
    shown = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    recipe = (ROOT / "recipes/locus/overlay.yaml").read_text(encoding="utf-8")
    assert [yaml.safe_load(text) for text in shown] == [yaml.safe_load(recipe)]


def test_slots_and_their_defaults() -> None:
    rows = re.findall(
        r"^\| `([\w.]+)` \|[^|]*\|([^|]*)\|", page("recipes.md").split("\n## ")[1], re.MULTILINE
    )
    shown = {name.rpartition(".")[2]: re.findall(r"`([^`]+)`", types) for name, types in rows}
    defaults = {name: [slot.default] if slot.default else [] for name, slot in SLOTS.items()}
    defaults |= {name: list(s.defaults.values()) for name, s in SECTIONS.items() if s.named}
    assert shown == defaults


def test_commands() -> None:
    shown = re.findall(r"^\| `qgs ([\w-]+)", page("commands.md"), re.MULTILINE)
    assert set(shown) == {*COMMANDS, *entry_points(group=GROUP).names}


def test_paths_exist() -> None:
    paths = re.findall(r"[`(](?:\./)?((?:recipes|tools|docs|plugins|tests)/[\w./-]+)[`)]", README)
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120
