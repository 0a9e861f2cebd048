import zipfile
from pathlib import Path

import pytest
from commands import MODEL

from qgs.cli.train import with_absolute_path
from qgs.composer import resolve

RECIPE = {"recipe": 1, "model": MODEL}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("photos", "{here}/photos"),
        ("../photos", "{above}/photos"),
        ("~/photos", "{home}/photos"),
        ("/data/photos", "/data/photos"),
        ("memory://bucket/photos", "memory://bucket/photos"),
        ("zip://a::file://{here}/photos.zip", "zip://a::file://{here}/photos.zip"),
    ],
)
def test_paths_become_absolute_and_urls_stay(given, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"here": tmp_path, "above": tmp_path.parent, "home": Path.home()}
    zipfile.ZipFile(tmp_path / "photos.zip", "w").close()
    data = {"type": "qgs/photos", "path": given.format(**names), "image_size": [16, 16]}
    recipe = with_absolute_path(resolve({**RECIPE, "data": data}))
    assert recipe.tree["data"]["path"] == expected.format(**names)


def test_data_without_a_path_stays():
    data = {"type": "rooms/procedural", "image_size": [16, 16]}
    recipe = resolve({**RECIPE, "plugins": ["rooms"], "data": data})
    assert with_absolute_path(recipe).tree == recipe.tree
