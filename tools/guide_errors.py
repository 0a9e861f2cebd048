"""The messages on the guide's page of errors, produced by what stands above each of them.

A block of text on that page is what its recipe, or its Python code, raises. A Python block with a
distribution as its title is the module of a plugin that is installed meanwhile: "qgs-NAME VERSION",
or "DISTRIBUTION VERSION as NAME". One with the title "without NAME" runs where the package, or the
plugin, of that name is missing; it may load `model.safetensors`, whose recipe names `locus`.

`python tools/guide_errors.py` brings the page up to date; a test tells when it is not.
"""

import re
import sys
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr
from importlib.metadata import EntryPoint, entry_points
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from guide_reference import PLUGINS

import qgs
from qgs.contracts import MissingExtraError
from qgs.contracts.plugin import ENTRY_POINT_GROUP
from qgs.io.files import write_text

PAGE = Path(__file__).parents[1] / "docs/errors.md"
BLOCK = re.compile(
    r'^```(yaml|python|text)(?: title="([^"]*)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE
)

SMALL = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {"width": 32, "heads": 2, "queries": {"type": "locus/anchored", "count": 4}},
}
"""Recipe of the checkpoint that code of the page may load."""


def updated(page: str) -> str:
    """`page` with every block of text replaced by the message that belongs there."""
    message = ""

    def replaced(block: re.Match[str]) -> str:
        nonlocal message
        kind, title, text = block.groups()
        missing = (title or "").partition("without ")[2]
        if kind == "text":
            site = rf"{re.escape(str(folder))}/\w+/"
            return f"```text\n{re.sub(site, 'site-packages/', message)}\n```"
        if kind == "python" and missing:
            with patch.dict(sys.modules, {missing: None}), _plugins_of(folder, but=missing):
                message = _message(kind, "example", text)
        elif kind == "python" and title:
            _install(title, text, folder)
        else:
            message = _message(kind, title or "recipe.yaml", text)
        return block.group(0)

    with TemporaryDirectory() as name, chdir(name), _plugins_of(folder := Path(name)):
        qgs.save(qgs.compose(SMALL), "model.safetensors")
        return BLOCK.sub(replaced, page)


def _message(kind: str, name: str, text: str) -> str:
    """What a recipe raises when it is composed, or Python code when it is run."""
    try:
        if kind == "yaml":
            Path(name).write_text(text, encoding="utf-8")
            qgs.compose(name, device="meta")
        else:
            exec(compile(text, name, "exec"), {})  # the guide's own code
    except (ValueError, MissingExtraError) as error:
        return str(error)
    raise RuntimeError(f"this raises nothing, so the page is wrong:\n{text}")


def _install(distribution: str, source: str, folder: Path) -> None:
    """Make a module importable as the plugin of `distribution`, a block's title."""
    release, _, plugin = distribution.partition(" as ")
    name, version = release.split()
    module = name.replace("-", "_")
    site = folder / module
    info = site / f"{module}-{version}.dist-info"
    info.mkdir(parents=True)
    (site / f"{module}.py").write_text(source, encoding="utf-8")
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    entry = f"[qgs.plugins]\n{plugin or name.removeprefix('qgs-')} = {module}:plugin\n"
    (info / "entry_points.txt").write_text(entry, encoding="utf-8")
    sys.path.insert(0, str(site))


@contextmanager
def _plugins_of(folder: Path, but: str = "") -> Iterator[None]:
    """Of all plugins there are those of the repository and those in `folder`, not the one `but`.

    Afterwards `sys.path` and the imported plugins are as before; nothing goes to standard error.
    """

    def found(_: object) -> list[EntryPoint]:
        there = [entry for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.name != but]
        return [e for e in there if e.name in PLUGINS or (folder / e.module).is_dir()]

    modules = set(sys.modules)
    try:
        with (
            patch("qgs.extensions.installed", found),
            patch.object(sys, "path", [*sys.path]),
            redirect_stderr(StringIO()),
        ):
            yield
    finally:
        for name in set(sys.modules) - modules:
            if name.startswith("qgs_"):
                del sys.modules[name]


if __name__ == "__main__":
    write_text(PAGE, updated(PAGE.read_text(encoding="utf-8")))
