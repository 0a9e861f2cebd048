"""Poses of two photos: from features whose truth is known, and of a textured room."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
import torch
from commands import run_qgs
from PIL import Image
from qgs_photos.poses import learned, making, worker
from qgs_photos.poses.few import NO_MATCHES, RefusedError, beginning, described
from qgs_photos.poses.two_views import linked
from walked import PHOTOS, QUIET, assert_close, write_photos

SIZE = (640, 480)
FOCAL = 700.0
MOTION = (-1.2, 0.1, 0.3)


def turned(degrees):
    """About the vertical axis."""
    return pycolmap.Rotation3d(np.array([0, np.radians(degrees), 0])).matrix()


def seen_twice(degrees, translation, wrong=0.3, depths=(4, 9)):
    """Pixels (2, N, 2) of points from two cameras with noise; some of the second are elsewhere."""
    rotation = turned(degrees)
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, depths[0]], [2, 1.5, depths[1]], (400, 3))
    pixels = []
    for camera in (points, points @ rotation.T + translation):
        found = FOCAL * camera[:, :2] / camera[:, 2:] + np.array(SIZE) / 2
        pixels.append(found + rng.normal(0, 0.3, found.shape))
    count = int(wrong * len(points))
    pixels[1][:count] = rng.uniform(0, SIZE, (count, 2))
    return np.stack(pixels)


@pytest.fixture
def found(tmp_path):
    """What begins from pixels of two photos with equal descriptors; EXIF gives some focals."""

    def found(pixels, *focals):
        descriptors = np.random.default_rng(1).integers(0, 256, (len(pixels[0]), 128), np.uint8)
        kind = pycolmap.FeatureExtractorType.SIFT
        with pycolmap.Database.open(tmp_path / "database.db") as database:
            for place, focal in enumerate(focals):
                camera = pycolmap.Camera.create_from_model_name(
                    1, "SIMPLE_PINHOLE", focal or 1, *SIZE
                )
                camera.has_prior_focal_length = bool(focal)
                number = database.write_camera(camera)
                image = database.write_image(pycolmap.Image(name=f"{place}", camera_id=number))
                database.write_keypoints(image, pixels[place].astype(np.float32))
                features = pycolmap.FeatureDescriptors(data=descriptors, type=kind)
                database.write_descriptors(image, features)
            return beginning(database, described(database))

    return found


@pytest.mark.parametrize("focals", [(FOCAL, FOCAL), (0, 0), (FOCAL, 0), (2 * FOCAL, 2 * FOCAL)])
def test_two_views_give_pose_focal_length_and_points(found, focals):
    model, remarks, _ = found(seen_twice(12, MOTION), *focals)
    one, other = (model.images[place].cam_from_world().matrix() for place in (1, 2))
    assert np.array_equal(one, np.eye(3, 4))
    true = np.c_[turned(12), MOTION / np.linalg.norm(MOTION)]
    other[:, 3] /= np.linalg.norm(other[:, 3])
    assert np.linalg.norm(other - true) < np.radians(1)
    assert model.cameras[2].focal_length == pytest.approx(FOCAL, rel=0.04)
    points = np.array([point.xyz for point in model.points3D.values()])
    assert 260 <= len(points) <= 300
    assert np.median(points[:, 2]) == pytest.approx(1)
    assert bool(remarks) != (focals == (FOCAL, FOCAL))


@pytest.mark.parametrize(
    ("pixels", "reason"),
    [
        (seen_twice(8, 0), "turn on the spot"),
        (seen_twice(0, 0), "turn on the spot"),
        (seen_twice(8, (-1, 0, 0), wrong=0.97), "enough matches"),
        (seen_twice(8, (-1, 0, 0), depths=(6, 6)), "one flat thing"),
        (seen_twice(12, MOTION) * [[[1]], [[0.6]]], "different lenses"),
    ],
)
def test_two_photos_without_a_pose_are_refused(found, pixels, reason):
    with pytest.raises(RefusedError, match=reason):
        found(pixels, 0, 0)


def test_two_photos_get_poses_and_a_blank_one_none(images, shots, tmp_path):
    write_photos(tmp_path / "two", [images[3], images[5], np.full_like(images[0], 127)])
    shown = run_qgs(f"poses {tmp_path}/two --threads 1").output
    assert "2 of 3 photos have poses" in shown
    assert "times their longer side" in shown
    assert_close(tmp_path / "two_poses", [shots[3], shots[5]])


@pytest.fixture
def alone(monkeypatch):
    """COLMAP runs in this process, where it can be changed."""
    monkeypatch.setattr(making, "run", lambda job, show: worker.mapped(job).values())


def remarks_on_all(walk, folder):
    """Of all photos, which have poses."""
    made = making.make_poses(walk, folder / "made", making.Options(side=240), QUIET)
    assert len(made.posed) == PHOTOS
    return " ".join(made.remarks)


@pytest.mark.parametrize("least", ["few.PARALLAX", "worker.FEW_MATCHES"])
def test_a_start_of_colmap_or_of_a_pair_is_enough(walk, tmp_path, monkeypatch, least, alone):
    monkeypatch.setattr(f"qgs_photos.poses.{least}", np.inf)
    remarks_on_all(walk, tmp_path)


def detector(pixels):
    """The features of SIFT, as ALIKED finds its own."""
    extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
    points, found = extractor.extract_from_uint8_array((255 * pixels[0].mean(0)).byte().numpy())
    places = torch.tensor([(point.x - 0.5, point.y - 0.5) for point in points])
    data = torch.nn.functional.normalize(torch.from_numpy(found.data.astype(np.float32)), dim=-1)
    return [SimpleNamespace(keypoints=places.reshape(-1, 2), descriptors=data.reshape(-1, 128))]


def matcher(given):
    """As LightGlue does."""
    one, other = (given[name]["descriptors"][0].numpy() for name in ("image0", "image1"))
    if not len(one) or not len(other):
        return {"matches": [torch.zeros(0, 2).long()], "scores": [torch.zeros(0)]}
    links = linked(one, other)
    return {"matches": [torch.from_numpy(links.indices)], "scores": [torch.from_numpy(links.right)]}


@pytest.fixture
def learning(monkeypatch, tmp_path, alone):
    monkeypatch.setattr(worker, "weights", lambda: tmp_path)
    monkeypatch.setattr(learned, "SIDE", 200)
    monkeypatch.setattr(learned, "ALIKED", lambda *_, **__: detector)
    monkeypatch.setattr(learned, "LightGlue", lambda *_, **__: matcher)
    monkeypatch.setattr(learned, "_load", lambda *_: None)


def test_learned_features_give_poses_where_the_photos_have_them(images, shots, tmp_path, learning):
    """Of a reduced photo, a grey one, and one without any."""
    grey = Image.fromarray(images[3]).convert("L")
    write_photos(tmp_path / "two", [np.array(grey), images[5], np.zeros((64, 64, 3), np.uint8)])
    made = making.make_poses(tmp_path / "two", tmp_path / "made", making.Options(), QUIET)
    assert len(made.posed) == 2
    assert any("ALIKED" in remark for remark in made.remarks)
    assert_close(tmp_path / "made", [shots[3], shots[5]])


def test_learned_features_connect_photos(walk, tmp_path, learning):
    remarks_on_all(walk, tmp_path)


def test_sift_connects_photos_where_learned_features_do_not(walk, tmp_path, monkeypatch, learning):
    monkeypatch.setattr(learned, "learn", Mock(side_effect=RefusedError(NO_MATCHES)))
    assert "ALIKED" not in remarks_on_all(walk, tmp_path)
