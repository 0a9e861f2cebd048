"""The code of "Write a plug-in in 15 minutes", without an installation.

The slow tests in tests/outside type every command of the page in a fresh environment.
"""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from guide_pages import blocks
from photo_formats import noise, put, write_photos
from qgs_dev import Case, CaseRun, cases_of
from qgs_dev.new_command import rendered
from tables import must_refuse

from qgs.recipe import RecipeError, resolve
from qgs.recipe.registry import InstalledPlugin

WRITTEN = {str(path): text for path, text in rendered("sightline")}


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """That of the distribution as it is at the end of the page; we are in its folder."""
    files = {**WRITTEN}
    for title, text in (blocks("plugin.md", "python") | blocks("plugin.md", "yaml")).items():
        verb, _, path = title.partition(": ")
        if path:
            assert (path in files) == (verb == "change"), f"{title}: new or changed?"
            files[path] = text
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("qgs-sightline"))
        for path, text in files.items():
            put(Path(path), text.encode())
        patch.syspath_prepend(Path("src").resolve())
        yield import_module("qgs_sightline")


def test_the_page_shows_what_new_plugin_writes():
    code = blocks("plugin.md", "python")
    shown = {title: text for title, text in code.items() if ":" not in title}
    assert len(shown) == 3  # the component, the plugin and the test
    assert shown.items() <= WRITTEN.items()
    assert blocks("plugin.md", "toml").popitem()[1] in WRITTEN["pyproject.toml"]


def test_components_keep_their_contracts(package):
    cases = cases_of(InstalledPlugin(package.plugin))
    assert len(cases) == 9  # one of each component, and one more of its examples
    for case in cases:
        CaseRun(case).check(["core"])


def test_the_source_keeps_its_contract(package, tmp_path):
    for scene, photos in enumerate(noise(2, 9, 24, 40, 3)):
        folder = write_photos(tmp_path / str(scene), photos)
        np.save(folder / "poses.npy", [np.eye(4)] * 9)
        np.save(folder / "lens.npy", [30.0, 30.0, 20.0, 12.0])
    CaseRun(Case(package.ScanSource.Config(path=str(tmp_path)))).check(["core"])


def test_the_recipes_work_and_what_the_page_says_is_refused(package):
    plugins = [package.plugin]
    recipe = resolve("loss.yaml", plugins=plugins)
    assert recipe.tree["model"]["decoder"]["cross_attention"]["type"] == "sightline/abstaining"
    assert {*recipe.build_losses()} == {"visibility", "color"}
    assert isinstance(recipe.build_losses()["color"], package.Charbonnier)
    for name in ("depth.yaml", "cnn.yaml"):
        assert resolve(name, plugins=plugins)
    assert {*resolve("widening.yaml", plugins=plugins).tree["plugins"]} >= {"locus", "sightline"}
    needed = r"`sightline/deepen` needs sightline\.log_depth [\s\S]*use `sightline/deep`"
    must_refuse(
        needed,
        resolve,
        "depth.yaml",
        ["model.queries.type=qgs/latent"],
        plugins=plugins,
        kind=RecipeError,
    )
