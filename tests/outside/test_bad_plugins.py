"""Bad plugins, really installed: reported by distribution, and no other plugin is harmed."""

import shutil
from zipfile import ZipFile

import pytest
from fresh_environment import ROOT

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


def write_wheel(folder, distribution):
    plugin, source = SOURCES[distribution]
    module = distribution.replace("-", "_")
    info = f"{module}-0.7.dist-info"
    with ZipFile(folder / f"{module}-0.7-py3-none-any.whl", "w") as wheel:
        for name, text in (
            (f"{module}.py", source),
            (f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 0.7\n"),
            (f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"),
            (f"{info}/entry_points.txt", f"[qgs.plugins]\n{plugin} = {module}:plugin\n"),
            (f"{info}/RECORD", ""),
        ):
            wheel.writestr(name, text)


def test_recipes_that_use_one_are_refused_and_no_others(fresh, tmp_path):
    shutil.copytree(ROOT / "recipes/tiny", tmp_path / "tiny")
    for distribution in SOURCES:
        write_wheel(tmp_path, distribution)
    fresh.run("pip install -q --no-index --no-deps *.whl", tmp_path)
    assert "locus/ray_biased" in fresh.run("qgs compose tiny/locus.yaml", tmp_path)
    listed = " ".join(fresh.run("qgs list", tmp_path).split())
    assert [name for name in SOURCES if f"{name} 0.7" not in listed] == []
    assert "locus/ray_biased" in listed
    for distribution, (plugin, _) in SOURCES.items():
        recipe = f"recipe: 1\nextends: tiny/tokengs.yaml\nplugins: [{plugin}]\n"
        (tmp_path / f"{plugin}.yaml").write_text(recipe)
        refused = fresh.run(f"! qgs compose {plugin}.yaml", tmp_path)
        assert f"{plugin}.yaml:3: plugins.1" in refused
        assert f"{distribution} 0.7" in refused
        assert "Traceback" not in refused
    fresh.run(f"pip uninstall -q -y {' '.join(SOURCES)}", tmp_path)
    assert "bad-" not in fresh.run("pip list", tmp_path), "other tests use this environment too"
