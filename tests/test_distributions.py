"""Messages name the distributions of this repository, whose entry points are as told."""

import tomllib
from pathlib import Path

import qgs

ROOT = Path(__file__).parents[1]


def test_messages_name_the_distributions_of_this_repository():
    offered = {}
    for file in ROOT.glob("plugins/*/pyproject.toml"):
        project = tomllib.loads(file.read_text())["project"]
        for group, entries in project["entry-points"].items():
            offered.setdefault(group, {}).update(dict.fromkeys(entries, project["name"]))
    assert {group: offered[group] for group in qgs.DISTRIBUTIONS} == qgs.DISTRIBUTIONS
