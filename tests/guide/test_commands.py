"""Every command that the guide and the template of a plugin show is one that there is."""

import re
import shlex
import tomllib

from commands import run_qgs
from guide_pages import DOCS, all_pages, text_of
from qgs_dev.new_command import rendered

TEMPLATE = {path.name: text for path, text in rendered("sightline")}
TEXTS = all_pages() | {"README": TEMPLATE["README.md"] + text_of("../README.md")}
PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]
PLUGIN = tomllib.loads(TEMPLATE["pyproject.toml"])["project"]


COMMAND = re.compile(r"`qgs ([^`\n]+)`|^(?: {4}|! )?qgs (.+)$", re.MULTILINE)


def commands():
    for page, text in TEXTS.items():
        for found in COMMAND.finditer(text):
            shown = (found[1] or found[2]).partition("  #")[0].strip()
            if shown[0].islower():
                yield page, shown


def test_every_command_that_is_shown_is_one():
    """That it and its options exist is found before `--help` is answered."""
    shown = set(commands())
    assert {"index.md", "ideas.md", "plugin.md", "README"} <= dict(shown).keys()
    for page, text in sorted(shown):
        result = run_qgs(*shlex.split(text), "--help")
        assert result.exit_code == 0, f"{page}: qgs {text}: {result.output}"


def test_extras_that_are_named_exist():
    known = PROJECT["optional-dependencies"] | PLUGIN["optional-dependencies"]
    pattern = r"extras? `(\w+)`|(?:gaussians|\.)\[([\w,]+)\]"
    for word, several in re.findall(pattern, "".join(TEXTS.values())):
        assert {*(word or several).split(",")} <= known.keys()
