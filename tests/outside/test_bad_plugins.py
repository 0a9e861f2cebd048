"""Bad plugins, really installed: told by distribution, and nobody else is harmed."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from zipfile import ZipFile

import pytest
from fresh_environment import ROOT, FreshEnvironment

pytestmark = pytest.mark.slow

PLUGIN = "from qgs.contracts import Plugin\nplugin = Plugin('{name}', {version}, ())\n"

LIAR = """
import torch
from qgs.contracts import FieldSpec, Plugin, LearnedQueries
from qgs.types import QueryState

class Hollow(LearnedQueries):
    name = "hollow"
    count = 4

    @classmethod
    def fields_written(cls, config):
        return {"hollow.place": FieldSpec((3,), frame="world")}

    def start(self, batch_size):
        return QueryState(torch.zeros(batch_size, self.count, self.dims.width))

plugin = Plugin("liar", 1, (Hollow,))
"""

SOURCES = {
    "bad-raises": ("raises", "raise RuntimeError('no luck')\n", "RuntimeError: no luck"),
    "bad-twin": ("twin", PLUGIN.format(name="twin", version=1), "several distributions offer"),
    "worse-twin": ("twin", PLUGIN.format(name="twin", version=1), "several distributions offer"),
    "bad-namesake": ("namesake", PLUGIN.format(name="locus", version=1), "calls itself `locus`"),
    "bad-old": ("old", PLUGIN.format(name="old", version=0), "for contract version 0"),
    "bad-new": ("new", PLUGIN.format(name="new", version=99), "for contract version 99"),
    "bad-empty": ("empty", "", "has no attribute 'plugin'"),
    "bad-hungry": ("hungry", "import a_package_that_is_missing\n", "install `a_package_that_"),
    "bad-repeats": (
        "repeats",
        """
        from qgs.components import LatentQueries
        from qgs.contracts import Plugin
        plugin = Plugin("repeats", 1, (LatentQueries, LatentQueries))
        """,
        "registers `latent` twice",
    ),
}
"""Distribution -> name of its plugin, module, and what is told of it."""


def write_wheel(folder: Path, distribution: str, plugin: str, source: str) -> None:
    """A wheel with one module, as any build tool makes it."""
    module = distribution.replace("-", "_")
    info = f"{module}-0.7.dist-info"
    with ZipFile(folder / f"{module}-0.7-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{module}.py", dedent(source))
        wheel.writestr(
            f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 0.7\n"
        )
        tags = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        wheel.writestr(f"{info}/WHEEL", tags)
        wheel.writestr(f"{info}/entry_points.txt", f"[qgs.plugins]\n{plugin} = {module}:plugin\n")
        wheel.writestr(f"{info}/RECORD", "")


@pytest.fixture(scope="module")
def workshop(fresh: FreshEnvironment, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of recipes, while all bad plugins are installed at once."""
    folder = tmp_path_factory.mktemp("bad")
    for distribution, (plugin, source, _) in SOURCES.items():
        write_wheel(folder, distribution, plugin, source)
    write_wheel(folder, "bad-liar", "liar", LIAR)
    fresh.run("pip install -q --no-index --no-deps *.whl", folder)
    shutil.copytree(ROOT / "recipes/tiny", folder / "tiny")
    yield folder
    fresh.run(f"pip uninstall -q -y {' '.join(SOURCES)} bad-liar", folder)
    assert "bad-" not in fresh.run("pip list", folder), "other tests use this environment too"


def test_recipes_that_do_not_use_them_work(fresh: FreshEnvironment, workshop: Path) -> None:
    assert "locus/ray_biased" in fresh.run("qgs compose tiny/locus.yaml", workshop)
    assert "qgs/content" in fresh.run("qgs compose tiny/tokengs.yaml", workshop)


def test_the_list_names_each_and_goes_on(fresh: FreshEnvironment, workshop: Path) -> None:
    listed = " ".join(fresh.run("qgs list", workshop).split())
    for distribution, (_, _, told) in SOURCES.items():
        assert f"{distribution} 0.7" in listed
        assert told in listed
    assert "locus/ray_biased" in listed
    assert "liar/hollow" in listed


@pytest.mark.parametrize("distribution", SOURCES)
def test_a_recipe_that_uses_one_is_refused(
    distribution: str, fresh: FreshEnvironment, workshop: Path
) -> None:
    plugin, _, told = SOURCES[distribution]
    recipe = f"recipe: 1\nextends: tiny/tokengs.yaml\nplugins: [{plugin}]\n"
    (workshop / f"{plugin}.yaml").write_text(recipe, encoding="utf-8")
    refused = fresh.run(f"! qgs compose {plugin}.yaml", workshop)
    assert f"{plugin}.yaml:3: plugins.1" in refused
    assert f"{distribution} 0.7" in refused
    assert told in refused
    assert "Traceback" not in refused


def test_a_liar_is_told_by_its_check_and_in_training(
    fresh: FreshEnvironment, workshop: Path
) -> None:
    report = fresh.run("! qgs check-plugin liar", workshop)
    assert "plugin liar of bad-liar 0.7" in report
    assert "it does not write hollow.place" in report
    recipe = "recipe: 1\nextends: tiny/tokengs.yaml\nplugins: [liar]\n"
    queries = "model: {queries: {type: liar/hollow}}\n"
    (workshop / "liar.yaml").write_text(recipe + queries, encoding="utf-8")
    told = fresh.run("! qgs train liar.yaml --out run", workshop)
    assert "the plugin `liar` of bad-liar 0.7 fails: `liar/hollow` says that it provides" in told
    assert "Traceback" not in told
