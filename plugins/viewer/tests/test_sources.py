"""What `qgs view` makes of a PLY, and of a finished reconstruction with or without its model."""

import shlex
import shutil

import pytest
from commands import record_of
from photo_formats import noisy_photos
from qgs_viewer.opening import ModelSource, open_source
from qgs_viewer.query_scene import NEUTRAL
from small import model_of, sample_of
from tables import assert_equal, must_refuse, write_json
from walk import cloud

import qgs
from qgs.reconstruction.result import reconstruct_sample
from qgs.reconstruction.scene_formats import load_ply, save_ply


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """What `qgs reconstruct` leaves, by a model whose checkpoint lies beside it."""
    folder = tmp_path_factory.mktemp("finished")
    qgs.save(model_of("locus"), folder / "model.safetensors")
    model = qgs.load(folder / "model.safetensors")
    reconstruct_sample(model, sample_of(targets=(0, 2, 3, 5))).save(folder / "scene")
    return folder / "scene"


def test_photos_are_shown_by_the_model_for_their_size(tmp_path, monkeypatch):
    photos = str(tmp_path)
    monkeypatch.setattr("qgs_viewer.opening.open_model", lambda name, device, **given: name)
    assert open_source(photos, photos=None, size=(127, 300)) == "worlds/landmark-64"
    assert open_source(photos, photos=None, size=(128, 300)) == "worlds/landmark-256"
    assert open_source(photos, photos="others") == photos
    video = tmp_path / "walk.MP4"
    video.touch()
    assert open_source(str(video), photos=None) == "worlds/landmark-256"
    (tmp_path / "checkpoint.safetensors").touch()
    assert open_source(photos, photos=None) == photos


def test_a_scene_is_shown_with_photos_that_are_still_there(tmp_path):
    photos = noisy_photos(tmp_path / "my photos", 4)
    scene = tmp_path / "scene"
    scene.mkdir()
    save_ply(cloud(5), scene / "scene.ply")
    command = shlex.join(["qgs", "scene", str(photos), "--size", "16x16"])
    names = [f"images/{frame}.png" for frame in (0, 2)]
    write_json(scene / "metrics.json", {"command": command, "refined_on": names})
    source = open_source(str(scene))
    shown = source.scene_of(())
    assert shown.gaussians.count == 5
    assert shown.background == (0.0, 0.0, 0.0)
    assert_equal(shown.views.cameras.c2w, qgs.read_photos(photos).cameras.c2w[:, [0, 2]])
    assert shown.views.images.shape[-2:] == (16, 16)
    assert not source.notes
    shutil.rmtree(photos)
    source = open_source(str(scene))
    assert source.scene_of(()).views is None
    assert "my photos" in source.notes[0]


@pytest.fixture
def opened(finished, tmp_path):
    """Opens a copy of it with changes in its record, which a list of names reduces to those."""
    told = record_of(finished)
    folder = shutil.copytree(finished, tmp_path / "scene")

    def opened(*names, **changes):
        record = {name: told[name] for name in names} if names else {**told, **changes}
        write_json(folder / "cameras.json", record)
        return open_source(str(folder))

    return opened


def test_a_finished_reconstruction_has_its_queries(finished):
    source = open_source(str(finished))
    assert isinstance(source, ModelSource)
    assert [*source.frames] == [0, 1]
    assert [*source.notes] == []
    assert source.labels == [f"photos/0{frame}.png" for frame in (1, 4, 0, 2, 3, 5)]
    scene = source.scene_of(source.frames)
    ply = load_ply(finished / "gaussians.ply")
    assert scene.support(1) is not None
    far = (scene.gaussians.means - ply.means).norm(dim=-1).median()
    assert far < 0.01 * ply.means.std()  # its photos lost what 8 bits lose
    assert source.scene_of((0, 1, 2)).views.images.shape[1] == 3


def test_without_its_model_it_is_shown_as_it_is(opened):
    """Nothing is fetched on the word of a file."""
    url = "https://example.org/model.safetensors"
    for record, said in (
        ({"model": ""}, "not known"),
        ({"tuning": {"steps": 3}}, "tuning"),
        ({"refinement": {"steps": 3}}, "refinement"),
        ({"model": "gone/model.safetensors"}, "gone/model.safetensors"),
        ({"model": url}, url),
    ):
        source = opened(**record)
        scene = source.scene_of(source.frames)
        assert said in source.notes[0]
        assert (scene.queries, scene.support(0), len(scene.views.images[0])) == (0, None, 2), said


def test_a_reconstruction_keeps_its_background(opened):
    assert opened(model="", background=[0.0, 0.5, 1.0]).scene_of(()).background == (0.0, 0.5, 1.0)
    assert opened("scene", "views").scene_of(()).background == NEUTRAL
    must_refuse(r"cameras\.json does not describe a reconstruction", opened, background=[0.5])
