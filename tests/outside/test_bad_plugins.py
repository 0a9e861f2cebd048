"""Bad plugins, really installed: reported by distribution, and no other plugin is harmed."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import pytest
from fresh_environment import ROOT, FreshEnvironment

pytestmark = pytest.mark.slow

PLUGIN = "from qgs.contracts import Plugin\nplugin = Plugin('{}', {}, ())\n"
SOURCES = {
    "bad-raises": ("raises", "raise RuntimeError('no luck')\n"),
    "bad-twin": ("twin", PLUGIN.format("twin", 1)),
    "worse-twin": ("twin", PLUGIN.format("twin", 1)),
    "bad-namesake": ("namesake", PLUGIN.format("locus", 1)),
    "bad-new": ("new", PLUGIN.format("new", 99)),
    "bad-hungry": ("hungry", "import a_package_that_is_missing\n"),
}
"""Distribution -> name of its plugin, module."""


@pytest.fixture(scope="module")
def workshop(fresh: FreshEnvironment, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of recipes, while all bad plugins are installed at once."""
    folder = tmp_path_factory.mktemp("bad")
    for distribution, (plugin, source) in SOURCES.items():
        module = distribution.replace("-", "_")
        texts = {
            "METADATA": f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 0.7\n",
            "WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
            "entry_points.txt": f"[qgs.plugins]\n{plugin} = {module}:plugin\n",
            "RECORD": "",
        }
        with ZipFile(folder / f"{module}-0.7-py3-none-any.whl", "w") as wheel:
            wheel.writestr(f"{module}.py", source)
            for name, text in texts.items():
                wheel.writestr(f"{module}-0.7.dist-info/{name}", text)
    fresh.run("pip install -q --no-index --no-deps *.whl", folder)
    shutil.copytree(ROOT / "recipes/tiny", folder / "tiny")
    yield folder
    fresh.run(f"pip uninstall -q -y {' '.join(SOURCES)}", folder)
    assert "bad-" not in fresh.run("pip list", folder), "other tests use this environment too"


def test_other_recipes_compose_and_the_list_names_each(
    fresh: FreshEnvironment, workshop: Path
) -> None:
    assert "locus/ray_biased" in fresh.run("qgs compose tiny/locus.yaml", workshop)
    listed = " ".join(fresh.run("qgs list", workshop).split())
    assert [name for name in SOURCES if f"{name} 0.7" not in listed] == []
    assert "locus/ray_biased" in listed


@pytest.mark.parametrize("distribution", SOURCES)
def test_a_recipe_that_uses_one_is_refused(
    distribution: str, fresh: FreshEnvironment, workshop: Path
) -> None:
    plugin, _ = SOURCES[distribution]
    recipe = f"recipe: 1\nextends: tiny/tokengs.yaml\nplugins: [{plugin}]\n"
    (workshop / f"{plugin}.yaml").write_text(recipe, encoding="utf-8")
    refused = fresh.run(f"! qgs compose {plugin}.yaml", workshop)
    assert f"{plugin}.yaml:3: plugins.1" in refused
    assert f"{distribution} 0.7" in refused
    assert "Traceback" not in refused
