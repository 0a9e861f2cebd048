"""A plugin written outside this repository, beside the wheels of qgs, LocusGS and the tools."""

from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ORIGIN = """
import pathlib, qgs, qgs_locus, qgs_dev
print(*{pathlib.Path(x.__file__).parents[1] for x in (qgs, qgs_locus, qgs_dev)})
"""


def test_qgs_and_its_recipes_come_from_its_wheel(fresh, tmp_path):
    (origin,) = fresh.run(f'python -c "{ORIGIN}"', tmp_path).split()
    assert Path(origin).is_relative_to(fresh.folder)
    assert not list(fresh.folder.rglob("tests/test_recipes.py"))  # nothing of the source tree
    assert "tiny/locus.yaml" in fresh.run("qgs recipes", tmp_path)
    assert f"{fresh.folder}" in fresh.run("qgs compose rooms/locus_64.yaml", tmp_path)
    fresh.run("qgs recipes rooms/locus_64.yaml --out mine", tmp_path)
    assert f"{fresh.folder}" not in fresh.run("qgs compose mine/rooms/locus_64.yaml", tmp_path)
