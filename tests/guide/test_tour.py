"""The notebook runs top to bottom, and can be read without running it."""

import json
import re

import pytest
from guide_pages import DOCS
from tables import read_json

FILE = DOCS / "tour.ipynb"


def outputs(notebook):
    """For each cell of code the kinds of its outputs."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [[m for o in c["outputs"] for m in o.get("data", [o["output_type"]])] for c in cells]


def test_what_the_notebook_shows_is_stored():
    text = FILE.read_text()
    shown = outputs(json.loads(text))
    assert all(shown)
    assert sum("image/png" in kinds for kinds in shown) >= 6
    assert len(text) < 1_000_000
    assert not re.search(r'[" ]/(?:work|home|root|Users)/', text)


@pytest.mark.slow
def test_the_notebook_runs():
    names = {"display": print}
    for cell in read_json(FILE)["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["done"].steps > 1
    assert (names["run"] / "room.ply").is_file()
