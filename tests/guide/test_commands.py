"""Every command that the guide and the template of a plugin show is one that there is."""

import re
import shlex
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from guide_pages import DOCS, text_of
from qgs_plugintools.new_command import rendered
from typer.core import TyperGroup

from qgs.cli import app

TEMPLATE = {path.name: text for path, text in rendered("sightline")}
README = TEMPLATE["README.md"]
TEXTS = {path.name: text_of(path.name) for path in sorted(DOCS.glob("*.md"))} | {"README": README}
PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))["project"]
PLUGIN = tomllib.loads(TEMPLATE["pyproject.toml"])["project"]
EXTRAS, PLUGINS_EXTRAS = (set(p["optional-dependencies"]) for p in (PROJECT, PLUGIN))

UsageError = typer.BadParameter.__base__ or typer.BadParameter

COMMAND = re.compile(r"`qgs ([^`\n]+)`|^(?: {4}|! )?qgs (.+)$", re.MULTILINE)
PLACEHOLDER = re.compile(r"^(COMMAND|[A-Z]+=.*)$")


def commands() -> Iterator[tuple[str, str]]:
    for page, text in TEXTS.items():
        for found in COMMAND.finditer(text):
            shown = (found[1] or found[2]).partition("  #")[0].strip()
            if not PLACEHOLDER.match(shown.split()[0]) and re.match(r"[a-z]", shown):
                yield page, shown


SHOWN = sorted(set(commands()))


def parsed(words: list[str]) -> None:
    """Let the command line read `words`, without running anything; raises its UsageError."""
    command: Any = typer.main.get_command(app)
    context = command.make_context("qgs", list(words))
    while isinstance(command, TyperGroup):
        rest = [*context._protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)


@pytest.mark.parametrize(("page", "shown"), SHOWN)
def test_a_command_that_is_shown_is_one(page: str, shown: str) -> None:
    words = [word for word in shlex.split(shown) if word != "--help"]
    try:
        parsed(words)
    except UsageError as error:
        only_named = all(re.fullmatch(r"[a-z-]+", word) for word in words)
        if not (only_named and type(error).__name__ == "MissingParameter"):
            raise


def test_commands_are_found_on_every_page_that_has_some() -> None:
    assert {page for page, _ in SHOWN} >= {"README", "index.md", "ideas.md", "plugin.md"}
    assert ("index.md", "eval runs/locus") in SHOWN
    assert ("plugin.md", "check-plugin sightline") in SHOWN
    assert ("README", "check-plugin sightline") in SHOWN


@pytest.mark.parametrize("page", TEXTS)
def test_extras_that_are_named_exist(page: str) -> None:
    text = TEXTS[page]
    of_qgs = set(re.findall(r"extras? `(\w+)`", text))
    of_qgs |= {e for es in re.findall(r"gaussians\[([\w,]+)\]", text) for e in es.split(",")}
    installed = {e for es in re.findall(r"\.\[([\w,]+)\]", text) for e in es.split(",")}
    assert of_qgs <= EXTRAS
    assert installed <= (PLUGINS_EXTRAS if page in ("README", "plugin.md") else EXTRAS)


def test_a_plugin_depends_on_qgs_and_on_what_qgs_depends_on() -> None:
    ours, theirs = (
        {re.split(r"[^\w-]", entry)[0] for entry in sum(extras, project["dependencies"])}
        for project in (PROJECT, PLUGIN)
        for extras in [project["optional-dependencies"].values()]
    )
    of_ours = {"query-gaussians", "query-gaussians-plugintools"}
    assert theirs == {*of_ours, "pydantic", "torch", "pytest"}
    assert theirs <= {*of_ours, *ours}
