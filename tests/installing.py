"""A fixture that installs distributions in a folder of their own, for as long as a test runs."""

import sys
from textwrap import dedent

import pytest


@pytest.fixture
def install(tmp_path_factory, monkeypatch):
    """Make a distribution importable: install(distribution, plugin name, module source).

    group: of its entry point.
    """

    def install(distribution, plugin, source, version="1.2", group="qgs.plugins"):
        folder = tmp_path_factory.mktemp("site")
        safe = distribution.replace("-", "_")
        (folder / f"_test_{safe}.py").write_text(dedent(source))
        info = folder / f"{safe}-{version}.dist-info"
        info.mkdir()
        metadata = f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        (info / "METADATA").write_text(metadata)
        (info / "entry_points.txt").write_text(f"[{group}]\n{plugin} = _test_{safe}:plugin\n")
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, f"_test_{safe}", raising=False)

    return install
