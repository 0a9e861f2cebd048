"""A plugin written outside this repository, beside the wheels of qgs, LocusGS and the tools."""

from pathlib import Path

import pytest
from fresh_environment import ROOT, FreshEnvironment

pytestmark = pytest.mark.slow

ORIGIN = """
import pathlib, qgs, qgs_locus, qgs_plugintools
for module in (qgs, qgs_locus, qgs_plugintools):
    print(pathlib.Path(module.__file__).parents[1])
"""


@pytest.fixture(scope="module")
def plugin(fresh: FreshEnvironment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a new plugin whose wheel is installed."""
    workshop = tmp_path_factory.mktemp("workshop")
    fresh.run("qgs new-plugin outside", workshop)
    folder = workshop / "qgs-outside"
    fresh.run("pip wheel -q --no-deps --wheel-dir dist . && pip install -q dist/*.whl", folder)
    return folder


def test_qgs_comes_from_its_wheel(fresh: FreshEnvironment, tmp_path: Path) -> None:
    origins = {Path(line) for line in fresh.run(f'python -c "{ORIGIN}"', tmp_path).split()}
    assert len(origins) == 1
    assert origins.pop().is_relative_to(fresh.folder)
    assert not list(fresh.folder.rglob(ROOT.name)), "nothing of the source tree"


def test_recipes_come_with_the_wheel(fresh: FreshEnvironment, tmp_path: Path) -> None:
    assert "tiny/locus.yaml" in fresh.run("qgs recipes", tmp_path)
    listed = fresh.run("qgs compose rooms/locus_64.yaml", tmp_path)
    assert f"{fresh.folder}" in listed
    fresh.run("qgs recipes rooms/locus_64.yaml --out mine", tmp_path)
    assert f"{fresh.folder}" not in fresh.run("qgs compose mine/rooms/locus_64.yaml", tmp_path)


def test_its_tests_pass(fresh: FreshEnvironment, plugin: Path) -> None:
    output = fresh.run("python -m pytest -q", plugin)
    assert " passed" in output


def test_it_passes_the_check_of_the_command_line(fresh: FreshEnvironment, plugin: Path) -> None:
    report = fresh.run("qgs check-plugin outside", plugin)
    assert "cross_attention/abstaining" in report
    assert " 0 failed" in report


def test_a_recipe_trains_with_it(fresh: FreshEnvironment, plugin: Path) -> None:
    assert "outside/abstaining" in fresh.run("qgs compose recipe.yaml", plugin)
    small = "--set training.steps=3 --set optimizer.warmup=1 --set evaluation.scenes=1"
    fresh.run(f"qgs train recipe.yaml --out run {small}", plugin)
    assert (plugin / "run/checkpoint.safetensors").is_file()


def test_locus_passes_the_check_of_the_command_line(
    fresh: FreshEnvironment, tmp_path: Path
) -> None:
    report = fresh.run("qgs check-plugin locus", tmp_path, timeout=180)
    assert "cross_attention/ray_biased" in report
    assert " 0 failed" in report
