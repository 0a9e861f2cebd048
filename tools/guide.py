"""The parts of the guide that are written from the code, and the hook of mkdocs that adds them.

Pages are readable in the repository too. A module or name is documented where its entry stands, a
link to its file with the first sentence of its docstring; the site has all its documentation there,
by mkdocstrings. A link from a name in code to its file leads to this documentation on the site.
Between `<!-- from the code: NAME -->` and `<!-- end -->` stands what is read in
the repository in place of the part NAME.

`python tools/guide.py` writes entries and tables of the pages anew; for a new entry write
`::: NAME`, for a new link ``[`LABEL`][NAME]``. `python tools/guide.py reference` prints the recipe
reference, of the Configs of what is installed; building the guide puts it on the site.
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
from qgs_dev.schema import settings_schema
from qgs_dev.tables import option_rows

from qgs.contracts import Component, ComponentConfig
from qgs.recipe import slots
from qgs.recipe.registry import default_config, load_usable_plugins
from qgs.recipe.sections import SETTINGS
from qgs.recipe.slots import summary_of

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
"""Settings that are no components, by their place in a recipe."""


def filled(page: str) -> str:
    """`page` as the site needs it, with all parts that are written from the code."""
    page = PART.sub(lambda found: PARTS[found[1]](), page)
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
    """Return a link to the module that has `name`, labelled with the rest of the name."""
    module = name
    while not inspect.ismodule(found := resolve_name(module)):
        module = module.rpartition(".")[0]
    return f"[`{name.removeprefix(f'{module}.')}`]({up}{_file(found)})"


def _file(found: Any) -> str:
    file = Path(inspect.getsourcefile(inspect.unwrap(found)) or "").resolve()
    return file.relative_to(ROOT).as_posix()


def _entry(name: str, options: str | None) -> str:
    """Return a link from docs/api/ to the file of `name`, with its docstring's first paragraph."""
    found = resolve_name(name)
    line = f"[`{name}`](../../{_file(found)}): {summary_of(found)}"
    return line + (f"\n<!-- {options} -->" if options else "")


def _part(name: str, text: str) -> str:
    # The recipe reference is long, and every new option changes it: the repository links to it.
    if name != "recipe reference":
        text = PARTS[name]()
    return f"<!-- from the code: {name} -->\n{text}<!-- end -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill a page; mkdocs calls this for each one."""
    return filled(markdown)


def check_list() -> str:
    """Return tables of all checks by subject, Markdown."""
    return filled_template(
        "guide_checks.md.jinja",
        modules=groupby(CHECKS.values(), key=lambda check: check.function.__module__),
        title=lambda module: module.rpartition(".")[2].capitalize(),
        summary=lambda module: summary_of(sys.modules[module]),
        in_words=_slots_in_words,
    )


def _slots_in_words(of: Collection[str]) -> str:
    named = [f"`{slot}`" for slot in slots.SLOTS if slot in of]
    others = [f"`{slot}`" for slot in slots.SLOTS if slot not in of]
    if len(others) < len(named):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(named)


def filled_template(name: str, **values: Any) -> str:
    """Return what a template beside this file gives."""
    text = Path(__file__).with_name(name).read_text("utf-8")
    return Template(text, trim_blocks=True).render(values)


def reference() -> str:
    """Return tables of all sections and of all components by slot, Markdown."""
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
    """Return a table of all options of `config`: values, default, meaning."""
    rows = [("option", "values", "default", "meaning"), ("---",) * 4]
    for name, values, default, meaning in option_rows(settings_schema(config)["properties"]):
        values = values.replace("or schedule", "or a [schedule](#schedules)")
        rows.append((f"`{name}`", values, f"`{default.splitlines()[0]}`", meaning))
    cells = ([cell.replace("|", "\\|") for cell in row] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in cells) if rows[2:] else "No options."


def fields_of(component: type[Component]) -> Mapping[str, Mapping[str, Any]]:
    """Return the fields that a component reads and writes by default; none if it has no default."""
    config = default_config(component)
    if config is None:
        return {}
    return {"reads": component.fields_read(config), "writes": component.fields_written(config)}


def contract_list() -> str:
    """Return the signatures of all contracts, and the containers that they exchange, Markdown."""
    return filled_template(
        "guide_contracts.md.jinja", slots=slots, inspect=inspect, resolve=resolve_name
    )


PARTS = {"recipe reference": reference, "checks": check_list, "contracts": contract_list}
"""What writes each part of a page, by its name."""


def main() -> None:
    """Write all pages of the guide anew, or print the reference."""
    if sys.argv[1:] == ["reference"]:
        print(reference())
        return
    for path in (ROOT / "docs").rglob("*.md"):
        path.write_text(written(path.read_text("utf-8"), path.parent), "utf-8")


if __name__ == "__main__":
    main()
