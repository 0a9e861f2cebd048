"""Which source opens a path: those of qgs and of plugins alike."""

import yaml
from photo_formats import put
from qgs_photos.datasets import plugin as datasets
from tables import must_not_find
from tape_source import TapeSource, plugin, write_tape
from upath import UPath

from qgs.contracts import SceneSourceConfig
from qgs.data import PhotosSource
from qgs.data.recognition import open_for, recognised
from qgs.recipe.registry import BUILTIN, InstalledPlugin, Registry

HASH = "0a" * 32
HOLDINGS = """
train/index.json: datasets/chunks
test/000000.torch: datasets/chunks
000000.torch: datasets/chunks
transforms.json: qgs/photos
transforms_train.json: qgs/photos
poses_bounds.npy: qgs/photos
scene/transforms.json: qgs/photos
train/scene/transforms.json: qgs/photos
HASH.zip: datasets/dl3dv
1K/HASH.zip: datasets/dl3dv
HASH/transforms.json: datasets/dl3dv
HASH/gaussian_splat/transforms.json: datasets/dl3dv
garden/nerfstudio/transforms.json: datasets/dl3dv
2K/garden/gaussian_splat/transforms.json: datasets/dl3dv
garden.tape: tapes/tape
readme.txt: qgs/photos
"""
"""A file in a folder, and the source that opens the folder."""
SOURCES = Registry(
    {"qgs": BUILTIN, "datasets": InstalledPlugin(datasets), "tapes": InstalledPlugin(plugin)}
).components("data")


def test_by_content(tmp_path):
    expected = yaml.safe_load(HOLDINGS.replace("HASH", HASH))
    for place in (str(tmp_path), f"memory://recognition{tmp_path}"):
        found = {}
        for number, held in enumerate(expected):
            root = UPath(place) / f"place{number}"
            put(root / held, b"")
            found[held] = recognised(root, SOURCES)
        assert found == expected


def test_files_and_nothing(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"")
    assert recognised(UPath(tmp_path / "a.zip"), SOURCES) == "datasets/dl3dv"
    must_not_find("does not exist", recognised, UPath(tmp_path / "b"), SOURCES)


def test_a_plugin_is_asked_before_qgs_and_both_are_named(tmp_path, caplog):
    for name in ("transforms.json", "a.tape"):
        (tmp_path / name).write_bytes(b"")
    assert recognised(UPath(tmp_path), SOURCES) == "tapes/tape"
    assert "tapes/tape and of qgs/photos" in caplog.text


def test_a_plugin_that_fails_hinders_no_other(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(TapeSource, "recognises", classmethod(lambda cls, path: {}[path]))
    assert recognised(UPath(tmp_path), SOURCES) == "qgs/photos"
    assert "tapes/tape" in caplog.text


def test_options_for_other_data_and_for_that_of_the_training(tmp_path):
    write_tape(tmp_path / "a.tape")
    black = PhotosSource.Config(path="elsewhere", background=(0.0, 0.0, 0.0), holdout=3)
    trained = TapeSource.Config(path=str(tmp_path / ".." / tmp_path.name), image_size=(16, 16))
    for size, of, opened_at in (((8, 8), black, (8, 8)), (None, trained, (16, 16))):
        source, known = open_for(str(tmp_path), size, of, SOURCES)
        assert source.config == TapeSource.Config(path=str(tmp_path), image_size=opened_at)
        assert known == (of is trained)
    other = PhotosSource.config_for("there", (8, 8), black)
    assert other == black.model_copy(update={"path": "there", "image_size": (8, 8), "holdout": 0})
    assert PhotosSource.config_for("there", (8, 8), SceneSourceConfig()).holdout == 0
