"""Every command that the guide and the template of a plugin show is one that there is."""

import re
import shlex
import tomllib
from typing import Any

import typer
from guide_pages import DOCS, text_of
from qgs_dev.new_command import rendered
from typer.core import TyperGroup

from qgs.cli import app

TEMPLATE = {path.name: text for path, text in rendered("sightline")}
README = TEMPLATE["README.md"]
TEXTS = {path.name: text_of(path.name) for path in sorted(DOCS.glob("*.md"))} | {"README": README}
PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]
PLUGIN = tomllib.loads(TEMPLATE["pyproject.toml"])["project"]

UsageError = typer.BadParameter.__base__ or typer.BadParameter

COMMAND = re.compile(r"`qgs ([^`\n]+)`|^(?: {4}|! )?qgs (.+)$", re.MULTILINE)
PLACEHOLDER = re.compile(r"^(COMMAND|[A-Z]+=.*)$")


def commands():
    for page, text in TEXTS.items():
        for found in COMMAND.finditer(text):
            shown = (found[1] or found[2]).partition("  #")[0].strip()
            if not PLACEHOLDER.match(shown.split()[0]) and re.match(r"[a-z]", shown):
                yield page, shown


def parse(group, words):
    """Let the command line read `words`, without running anything; raises its UsageError."""
    command = group
    context = group.make_context("qgs", list(words))
    while isinstance(command, TyperGroup):
        rest = [*context._protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)


def test_every_command_that_is_shown_is_one():
    shown = set(commands())
    seen = {"index.md": "eval runs/locus", "plugin.md": "check-plugin sightline"}
    assert shown >= {*seen.items(), ("README", seen["plugin.md"])}
    assert "ideas.md" in dict(shown)
    group: Any = typer.main.get_command(app)
    for page, text in sorted(shown):
        words = [word for word in shlex.split(text) if word != "--help"]
        try:
            parse(group, words)
        except UsageError as error:
            only_named = all(re.fullmatch(r"[a-z-]+", word) for word in words)
            if not (only_named and type(error).__name__ == "MissingParameter"):
                raise AssertionError(f"{page}: qgs {text}") from error


def test_extras_that_are_named_exist():
    known = PROJECT["optional-dependencies"] | PLUGIN["optional-dependencies"]
    pattern = r"extras? `(\w+)`|(?:gaussians|\.)\[([\w,]+)\]"
    for word, several in re.findall(pattern, "".join(TEXTS.values())):
        assert {*(word or several).split(",")} <= known.keys()
