"""Command `qgs new-plugin`, which writes a plugin template: component, test and recipe."""

import keyword
import re
import shlex
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points, packages_distributions
from pathlib import Path, PurePosixPath
from typing import Annotated

import typer

app = typer.Typer(add_completion=False)


@app.command()
def new_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, as in `type: NAME/component`.")],
    out: Annotated[
        Path | None, typer.Option(help="New folder for the plugin. Default: ./qgs-NAME.")
    ] = None,
) -> None:
    """Write a new plugin from a template: one component, its contract tests, and a recipe."""
    from qgs.files import refuse_existing, write_text

    check_name(name)
    folder = (out or Path(distribution_of(name))).expanduser()
    refuse_existing(folder)
    for path, text in rendered(name):
        write_text(folder / path, text)
    typer.echo(
        f"wrote {folder}; next steps (the recipe needs query-gaussians-worlds):\n"
        f"  cd {shlex.quote(str(folder))}\n"
        "  pip install -e '.[test]'\n"
        "  python -m pytest\n"
        "  qgs compose recipe.yaml"
    )


def distribution_of(name: str) -> str:
    """Return the name under which pip installs the plugin `name`."""
    return f"qgs-{name.replace('_', '-')}"


def check_name(name: str) -> None:
    """Raise ValueError for a plugin name that is invalid or already taken."""
    module = name.replace("-", "_")
    if not re.fullmatch("[a-z][a-z0-9]*([-_][a-z0-9]+)*", name) or keyword.iskeyword(module):
        raise ValueError(
            f"`{name}` cannot name a plugin: use lower-case letters and digits, a letter first, "
            "join words by single hyphens or _, and avoid keywords of Python"
        )
    # The new package must neither hide an installed one nor be hidden by it.
    other = f"choose another name, such as `{name}-things`"
    if module in sys.stdlib_module_names or module in packages_distributions():
        raise ValueError(f"the name `{name}` is taken by an installed package; {other}")
    for entry in entry_points(group="qgs.plugins", name=name):
        owner = entry.dist.name if entry.dist else "a plugin"
        raise ValueError(f"the plugin name `{name}` is taken by {owner}; {other}")
    if name in ("null", "true", "false"):
        raise ValueError(f"YAML reads `{name}` as a constant, not as text; {other}")


def rendered(name: str) -> Iterator[tuple[PurePosixPath, str]]:
    """Yield path and content of every file of the template, filled in for the plugin `name`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    import qgs

    loader = PackageLoader("qgs_dev", "template")
    environment = Environment(loader=loader, undefined=StrictUndefined, keep_trailing_newline=True)
    major, minor = qgs.__version__.split(".")[:2]
    values = {
        "name": name,
        "distribution": distribution_of(name),
        "package": f"qgs_{name.replace('-', '_')}",
        "contract_version": qgs.CONTRACT_VERSION,
        "oldest_qgs": f"{major}.{minor}",
        "next_qgs": f"{major}.{int(minor) + 1}",
    }
    for file in environment.list_templates(extensions=["jinja"]):
        path = PurePosixPath(file).with_suffix("")
        parts = [values["package"] if part == "package" else part for part in path.parts]
        yield PurePosixPath(*parts), environment.get_template(file).render(values)
