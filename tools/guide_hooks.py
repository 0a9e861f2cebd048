"""The parts of the guide that are written from the code, and the hook of mkdocs that adds them.

Pages are readable in the repository too. A module or name is documented where its entry stands, a
link to its file with the first sentence of its docstring; the site has all its documentation there,
by mkdocstrings. A link from a name in code to its file leads to this documentation on the site.
Between `<!-- from the code: NAME -->` and `<!-- end -->` stands what is read in
the repository in place of the part NAME.

`python tools/guide_hooks.py` writes entries and tables of the pages anew; for a new entry write
`::: NAME`, for a new link ``[`LABEL`][NAME]``.
"""

import inspect
import re
import sys
from collections.abc import Collection
from itertools import groupby
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from guide_reference import filled_template, reference
from qgs_dev import CHECKS

from qgs.recipe.slots import SLOTS

ROOT = Path(__file__).parents[1]
PART = re.compile(r"^<!-- from the code: (.*) -->\n(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)
ENTRY = re.compile(
    r"^\[`([\w.]+)`\]\(\.\./\.\./\S+\).*(?:\n<!-- (options: .*) -->)?$", re.MULTILINE
)
DOCUMENTED = re.compile(r"^::: ([\w.]+)(?:\n    (options: .*))?$", re.MULTILINE)
CROSS = re.compile(r"\[`[\w.]+`\]\[([a-z_]+(?:\.\w+)+)\]")
TO_FILE = re.compile(
    r"\[`([\w.]+)`\]\((?:\.\./)+(?:plugins/\w+/src/)?((?:qgs|qgs_\w+)/[\w/]+)\.py\)"
)


def filled(page: str) -> str:
    """`page` as the site needs it, with all parts that are written from the code."""
    parts = {"recipe reference": reference, "checks": check_list}
    page = PART.sub(lambda found: parts[found[1]](), page)
    page = ENTRY.sub(lambda found: _block(found[1], found[2]), page)
    return TO_FILE.sub(_cross_reference, page)


def written(page: str, folder: Path) -> str:
    """`page` as it should be in the repository, in `folder`: links to files, the list of checks."""
    up = "../" * len(folder.relative_to(ROOT).parts)
    page = CROSS.sub(lambda found: _link(found[1], up), page)
    page = DOCUMENTED.sub(lambda found: _entry(found[1], found[2]), page)
    page = ENTRY.sub(lambda found: _entry(found[1], found[2]), page)
    return PART.sub(lambda found: _part(found[1], found[2]), page)


def _block(name: str, options: str | None) -> str:
    return f"::: {name}" + (f"\n    {options}" if options else "")


def _cross_reference(found: re.Match[str]) -> str:
    label, file = found.groups()
    return f"[`{label}`][{file.replace('/', '.').removesuffix('.__init__')}.{label}]"


def _link(name: str, up: str) -> str:
    """A link to the module that has `name`, labelled with the rest of it."""
    module = name
    while not inspect.ismodule(found := resolve_name(module)):
        module = module.rpartition(".")[0]
    return f"[`{name.removeprefix(f'{module}.')}`]({up}{_file(found)})"


def _file(found: Any) -> str:
    file = Path(inspect.getsourcefile(inspect.unwrap(found)) or "").resolve()
    return file.relative_to(ROOT).as_posix()


def _entry(name: str, options: str | None) -> str:
    """A link from docs/api/ to the file of `name`, with the first paragraph of its docstring."""
    found = resolve_name(name)
    line = f"[`{name}`](../../{_file(found)}): {_summary(found)}"
    return line + (f"\n<!-- {options} -->" if options else "")


def _summary(documented: Any) -> str:
    return " ".join((inspect.getdoc(documented) or "").split("\n\n")[0].split())


def _part(name: str, text: str) -> str:
    # The recipe reference is long, and every new option changes it: the repository links to it.
    text = check_list() if name == "checks" else text
    return f"<!-- from the code: {name} -->\n{text}<!-- end -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for each page."""
    return filled(markdown)


def check_list() -> str:
    """Return tables of all checks by subject, Markdown."""
    return filled_template(
        "guide_checks.md.jinja",
        modules=groupby(CHECKS.values(), key=lambda check: check.function.__module__),
        title=lambda module: module.rpartition(".")[2].capitalize(),
        summary=lambda module: _summary(sys.modules[module]),
        in_words=_slots_in_words,
    )


def _slots_in_words(slots: Collection[str]) -> str:
    named = [f"`{slot}`" for slot in SLOTS if slot in slots]
    others = [f"`{slot}`" for slot in SLOTS if slot not in slots]
    if len(others) < len(named):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(named)


def main() -> None:
    """Write all pages of the guide anew."""
    for path in (ROOT / "docs").rglob("*.md"):
        path.write_text(written(path.read_text("utf-8"), path.parent), "utf-8")


if __name__ == "__main__":
    main()
