"""`qgs new-plugin`: a distribution with one component, its test and a recipe, ready to change."""

import keyword
import os
import re
import shlex
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import (
    PackageNotFoundError,
    distribution,
    entry_points,
    packages_distributions,
)
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from jinja2 import Environment, StrictUndefined

import qgs
from qgs.composer.errors import Problems
from qgs.composer.yaml_text import load_mapping
from qgs.contracts import CONTRACT_VERSION
from qgs.io.files import refuse_existing, write_text

app = typer.Typer(add_completion=False)

NAME = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")
LONGEST_NAME = 40
WINDOWS_DEVICES = {"con", "prn", "aux", "nul"} | {
    f"{d}{i}" for d in ("com", "lpt") for i in "123456789"
}


@app.command()
def new_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, as in `type: NAME/component`.")],
    out: Annotated[
        Path | None, typer.Option(help="New folder, never overwritten; default: ./qgs-NAME.")
    ] = None,
) -> None:
    """Write a plugin to start from: one component, its contract tests, a recipe."""
    check_name(name)
    folder = (out or Path(distribution_of(name))).expanduser()
    write_plugin(name, folder)
    first = f"wrote {folder}; next, with query-gaussians-rooms installed for the recipe:"
    steps = f"cd {shlex.quote(str(folder))}", "pip install -e '.[test]'", "python -m pytest"
    typer.echo("\n  ".join([first, *steps, "qgs compose recipe.yaml"]))


def distribution_of(name: str) -> str:
    """What pip calls the distribution of the plugin `name`."""
    return f"qgs-{name.replace('_', '-')}"


def check_name(name: str) -> None:
    """Raise ValueError for a name that no plugin can have, or that an installed one has."""
    for refused, reason in _refusals(name):
        if refused:
            raise ValueError(f"`{name}` {reason}")


def _refusals(name: str) -> Iterator[tuple[object, str]]:
    """Whether something speaks against `name`, and what; each asked where nothing before does."""
    letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    near = re.sub(r"[^a-z0-9]+", "-", letters.lower()).lstrip("-0123456789").rstrip("-")
    meant = f"; did you mean `{near}`?" if NAME.fullmatch(near) else ""
    form = "lower-case letters and digits, a letter first, words joined by single hyphens or _"
    yield not NAME.fullmatch(name), f"is no name of a plugin: {form}{meant}"
    yield len(name) > LONGEST_NAME, f"has {len(name)} characters; {LONGEST_NAME} are the most"
    own = "begins like the framework's own name; its distribution is qgs-NAME, leave `qgs` out"
    yield re.match(r"qgs([-_]|$)", name), own
    other = f"choose another, such as `{name}-things`"
    yield name in WINDOWS_DEVICES, f"is the name of a device on Windows, and no file's; {other}"
    module, packages = name.replace("-", "_"), packages_distributions()
    yield keyword.iskeyword(module), f"is a word of Python's own, and no module's; {other}"
    of = ", ".join(dict.fromkeys(packages.get(module, ["Python itself"])))
    taken = module in sys.stdlib_module_names or module in packages
    yield taken, f"is the name of a package that is installed here ({of}); {other}"
    (value,) = load_mapping(f"name: {name}", name, Problems()).values()
    yield value != name, f"would be read as {value!r} in a recipe's `plugins: [{name}]`; {other}"
    for entry in entry_points(group="qgs.plugins", name=name):
        owner = entry.dist.name if entry.dist else "a plugin"
        yield True, f"is taken by {owner}, and of two plugins qgs would use neither; {other}"
    with suppress(PackageNotFoundError):
        there = distribution(distribution_of(name))
        replaced = f"{there.name} {there.version} is installed, which it would replace"
        yield True, f"would be the distribution {distribution_of(name)}; {replaced}; {other}"


@contextmanager
def new_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder that becomes `folder` when the block ends well.

    Makes missing parent folders. Raises FileExistsError if there is anything at `folder`, also
    when it appeared while the block ran. When the block raises, there is no `folder`.
    """
    target = Path(folder)
    refuse_existing(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as temporary:
        fresh = Path(temporary, target.name)
        fresh.mkdir()
        yield fresh
        refuse_existing(target)
        fresh.rename(target)


def write_plugin(name: str, folder: Path) -> None:
    """Write the distribution of the plugin `name` into the new `folder`, whole or not at all.

    Raises FileExistsError if there is anything at `folder`, OSError if none can be made there.
    """
    if folder.exists() or folder.is_symlink():
        raise FileExistsError(
            f"{folder} exists and is never overwritten; choose another folder with `--out FOLDER`"
        )
    try:
        with new_folder(folder) as fresh:
            for path, text in rendered(name):
                write_text(fresh / path, text)
    except OSError as error:
        raise OSError(
            f"cannot write {folder}: {error.strerror or error}; choose another folder with "
            "`--out FOLDER`"
        ) from error


def rendered(name: str) -> Iterator[tuple[PurePosixPath, str]]:
    """Every file of the distribution of the plugin `name`: path inside it, content."""
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True)
    major, minor = qgs.__version__.split(".")[:2]
    values = {
        "name": name,
        "distribution": distribution_of(name),
        "package": f"qgs_{name.replace('-', '_')}",
        "contract_version": CONTRACT_VERSION,
        "oldest_qgs": f"{major}.{minor}",
        "next_qgs": f"{major}.{int(minor) + 1}",
    }
    folder = Path(__file__).with_name("template")
    for file in sorted(folder.rglob("*.jinja")):
        path = file.relative_to(folder).with_suffix("")
        parts = [values["package"] if part == "package" else part for part in path.parts]
        text = environment.from_string(file.read_text(encoding="utf-8")).render(values)
        yield PurePosixPath(*parts), text
