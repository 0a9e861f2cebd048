"""One line installs all distributions of this repository, from a checkout and as a release."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def project(folder):
    return tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]


def test_all_distributions_are_named_where_everything_is_installed():
    folders = {path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml")}
    lines = (ROOT / "plugins/all.txt").read_text().splitlines()
    assert {f"-e plugins/{folder}" for folder in folders} <= {*lines}
    everything = project(".")["optional-dependencies"]["all"]
    released = {name.split(">")[0] for name in everything if name.startswith("query-")}
    assert released == {project(f"plugins/{folder}")["name"] for folder in folders}
    assert released == {f"query-gaussians-{folder}" for folder in folders}
