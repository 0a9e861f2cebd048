import zipfile
from pathlib import Path

import pytest

from qgs.cli.train import with_absolute_path
from qgs.composer import resolve

RECIPE = {
    "recipe": 1,
    "model": {
        "width": 16,
        "heads": 2,
        "encoder": {"type": "qgs/multiview_vit", "patch_size": 8, "depth": 1},
        "queries": {"type": "qgs/latent", "count": 8},
        "decoder": {"depth": 1},
        "head": {"type": "qgs/gaussian_head"},
        "supervision": {"type": "qgs/layers", "layers": [1]},
    },
}


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
    recipe = resolve(
        {
            **RECIPE,
            "plugins": ["rooms"],
            "data": {"type": "rooms/procedural", "image_size": [16, 16]},
        }
    )
    assert with_absolute_path(recipe).tree == recipe.tree
