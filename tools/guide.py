"""Generator of the parts of the guide that come from the code, and hook for mkdocs.

The pages can be read in the repository and on the site. In the repository, the entry of a module or
name is a link to its file with the first sentence of its docstring. On the site, mkdocstrings puts
the whole documentation in place of the entry, and links from names to files lead there. The text
between `<!-- from the code: NAME -->` and `<!-- end -->` is shown in the repository only; on the
site, the generated part NAME replaces it.

`python tools/guide.py` updates all entries and tables in the pages. For a new entry write
`::: NAME`, for a new link ``[`LABEL`][NAME]``. `python tools/guide.py reference` prints the recipe
reference: all options of the installed components. A build of the site includes it.
"""

import inspect
import re
import sys
from collections.abc import Collection, Mapping
from itertools import groupby
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from jinja2 import Template
from qgs_dev import CHECKS
from qgs_dev.schema import option_rows, settings_schema

from qgs.contracts import Component, ComponentConfig
from qgs.recipe import slots
from qgs.recipe.registry import default_config, load_usable_plugins
from qgs.recipe.sections import SETTINGS

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
REGISTRY = load_usable_plugins()[0]
SECTIONS = {".".join(path) or "Top level": config for path, config in SETTINGS.items()}
"""Sections of settings that are not components, by their path in a recipe."""


def filled(page: str) -> str:
    """Return a page for the site, with all generated parts filled in."""
    page = PART.sub(lambda found: PARTS[found[1]](), page)
    page = ENTRY.sub(_block, page)
    return TO_FILE.sub(_cross_reference, page)


def written(page: str, folder: Path) -> str:
    """Return a page for the repository, with links to files and generated lists.

    folder: folder of the page.
    """
    up = "../" * len(folder.relative_to(ROOT).parts)
    page = CROSS.sub(lambda found: _link(found[1], up), page)
    for pattern in (DOCUMENTED, ENTRY):
        page = pattern.sub(_entry, page)
    return PART.sub(_part, page)


def _block(found: re.Match[str]) -> str:
    name, options = found.groups()
    return f"::: {name}" + (f"\n    {options}" if options else "")


def _cross_reference(found: re.Match[str]) -> str:
    label, file = found.groups()
    return f"[`{label}`][{file.replace('/', '.').removesuffix('.__init__')}.{label}]"


def _link(name: str, up: str) -> str:
    """Return a Markdown link to the file that defines `name`.

    up: path from the page to the repository.
    """
    module = name
    while not inspect.ismodule(found := resolve_name(module)):
        module = module.rpartition(".")[0]
    return f"[`{name.removeprefix(f'{module}.')}`]({up}{_file(found)})"


def _file(found: Any) -> str:
    file = Path(inspect.getsourcefile(inspect.unwrap(found)) or "").resolve()
    return file.relative_to(ROOT).as_posix()


def _entry(found: re.Match[str]) -> str:
    """Return a link from docs/api/ to the file of a name, with its docstring's first paragraph."""
    name, options = found.groups()
    named = resolve_name(name)
    line = f"[`{name}`](../../{_file(named)}): {slots.summary_of(named)}"
    return line + (f"\n<!-- {options} -->" if options else "")


def _part(found: re.Match[str]) -> str:
    name, text = found.groups()
    # The recipe reference is long, and every new option changes it: the repository links to it.
    if name != "recipe reference":
        text = PARTS[name]()
    return f"<!-- from the code: {name} -->\n{text}<!-- end -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the generated parts of a page. mkdocs calls this hook for each page."""
    return filled(markdown)


def check_list() -> str:
    """Return Markdown tables of all checks of the contract suite, by subject."""
    return filled_template(
        "guide_checks.md.jinja",
        modules=groupby(CHECKS.values(), key=lambda check: check.function.__module__),
        title=lambda module: module.rpartition(".")[2].capitalize(),
        summary=lambda module: slots.summary_of(sys.modules[module]),
        in_words=_slots_in_words,
    )


def _slots_in_words(of: Collection[str]) -> str:
    named = [f"`{slot}`" for slot in slots.SLOTS if slot in of]
    others = [f"`{slot}`" for slot in slots.SLOTS if slot not in of]
    if len(others) < len(named):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(named)


def filled_template(name: str, **values: Any) -> str:
    """Return the text of the template `name` in this folder, filled with `values`."""
    text = Path(__file__).with_name(name).read_text("utf-8")
    return Template(text, trim_blocks=True).render(values)


def reference() -> str:
    """Return Markdown tables of the options of all sections and components."""
    return filled_template(
        "guide_reference.md.jinja",
        sections=SECTIONS,
        slots=slots,
        registry=REGISTRY,
        option_table=option_table,
        fields_of=fields_of,
        paragraphs=lambda documented: inspect.cleandoc(documented.__doc__ or "").split("\n\n"),
        is_attribute=lambda text: re.match(r"\w+: ", text),
    )


def option_table(config: type[ComponentConfig]) -> str:
    """Return a Markdown table of the options of `config`: type, default and meaning."""
    rows = [("option", "values", "default", "meaning"), ("---",) * 4]
    for name, values, default, meaning in option_rows(settings_schema(config)["properties"]):
        values = values.replace("or schedule", "or a [schedule](#schedules)")
        rows.append((f"`{name}`", values, f"`{default.splitlines()[0]}`", meaning))
    cells = ([cell.replace("|", "\\|") for cell in row] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in cells) if rows[2:] else "No options."


def fields_of(component: type[Component]) -> Mapping[str, Mapping[str, Any]]:
    """Return the fields that a component reads and writes with its default options.

    The result is empty for a component without valid default options.
    """
    config = default_config(component)
    if config is None:
        return {}
    return {"reads": component.fields_read(config), "writes": component.fields_written(config)}


def contract_list() -> str:
    """Return Markdown with the signatures of all contracts and the types that they exchange."""
    return filled_template(
        "guide_contracts.md.jinja", slots=slots, inspect=inspect, resolve=resolve_name
    )


PARTS = {"recipe reference": reference, "checks": check_list, "contracts": contract_list}
"""Functions that generate the parts of pages, by name of the part."""


def main() -> None:
    """Update all pages of the guide, or print the recipe reference."""
    if sys.argv[1:] == ["reference"]:
        print(reference())
        return
    for path in (ROOT / "docs").rglob("*.md"):
        path.write_text(written(path.read_text("utf-8"), path.parent), "utf-8")


if __name__ == "__main__":
    main()
