"""Poses of a textured room against the ones that its photos were rendered with."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_poses import aligned
from PIL import Image
from qgs_poses import making
from qgs_poses.making import Options, make_poses, read_record
from qgs_poses.photos import PosesError
from upath import UPath
from walked import PHOTOS, quiet, write_video

from qgs.data.photos import formats_of, read_listing

ORIENTATION = 0x0112


def errors(folder: Path, shots) -> tuple[float, float]:
    frames = read_listing(UPath(folder)).frames
    known = {f"{number}": shot.c2w for number, shot in enumerate(shots)}
    truth = np.stack([known[frame.path.stem.lstrip("0") or "0"] for frame in frames])
    turn, distance = aligned(np.stack([frame.c2w for frame in frames]), truth)
    return float(np.median(turn)), float(np.median(distance))


def test_photos_get_the_poses_they_were_taken_with(made, shots, walk):
    assert made.posed == [f"{number}.jpg" for number in range(PHOTOS)]
    assert formats_of(UPath(made.folder)) == ["colmap"]
    turn, distance = errors(made.folder, shots)
    assert turn < 1
    assert distance < 0.02
    assert next(made.summary) == f"{PHOTOS} of {PHOTOS} photos have poses"
    record = read_record(made.folder)
    assert record is not None
    assert set(record["source"]) == {file.name for file in walk.iterdir()}
    assert not (made.folder / "working").exists()


@pytest.mark.slow
def test_one_thread_and_a_seed_give_the_same_file(walk, tmp_path):
    files = []
    for name in "ab":
        folder = make_poses(walk, tmp_path / name, Options(threads=1), quiet()).folder
        files.append((folder / "sparse" / "0" / "images.bin").read_bytes())
    assert files[0] == files[1]


def test_photos_turned_by_exif_are_upright_and_large_ones_are_seen_small(shots, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = 6  # a quarter turn clockwise makes it upright
    for number, shot in enumerate(shots[:6]):
        image = Image.fromarray(shot.image)
        turned = image.transpose(Image.Transpose.ROTATE_90) if number % 2 else image
        turned.save(folder / f"{number}.jpg", quality=95, **({"exif": exif} if number % 2 else {}))
    made = make_poses(folder, tmp_path / "poses", Options(side=400), quiet())
    sizes = {Image.open(made.folder / "images" / name).size for name in made.posed}
    assert sizes == {shots[0].image.shape[1::-1]}
    assert len(made.posed) == 6
    frames = read_listing(UPath(made.folder)).frames
    assert {frame.size for frame in frames} == {shots[0].image.shape[:2]}
    assert errors(made.folder, shots)[0] < 1
    # points of the model lie on the photos as they are kept, not on the copies that COLMAP saw
    assert frames[0].intrinsics[0] == pytest.approx(435, rel=0.05)


@pytest.mark.slow
def test_a_killed_call_is_finished_and_finished_ones_stay(walk, tmp_path, monkeypatch):
    out = tmp_path / "poses"

    def killed(*rest: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(making, "_moved", killed)
        with pytest.raises(KeyboardInterrupt):
            make_poses(walk, out, Options(), quiet())
    assert read_record(out) is None
    database = (out / "working" / "database.db").stat().st_ino
    monkeypatch.setattr(making.shutil, "rmtree", _all_but(out / "working", making.shutil.rmtree))
    made = make_poses(walk, out, Options(threads=1), quiet())  # another number wipes nothing
    assert len(made.posed) == PHOTOS
    assert (out / "working" / "database.db").stat().st_ino == database
    with pytest.raises(FileExistsError):
        make_poses(walk, out, Options(), quiet())


def _all_but(kept: Path, remove):
    return lambda path, **options: None if path == kept else remove(path, **options)


def test_other_folders_are_left_alone(walk, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    for taken in (tmp_path / "mine", tmp_path / "mine" / "notes.txt"):
        with pytest.raises(FileExistsError):
            make_poses(walk, taken, Options(), quiet())
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"


@pytest.mark.slow
def test_photos_of_two_places_give_the_larger_model(shots, tmp_path):
    import textured_room

    folder = tmp_path / "both"
    folder.mkdir()
    for number, shot in enumerate(shots):
        Image.fromarray(shot.image).save(folder / f"{number}.jpg", quality=95)
    walls = np.random.default_rng(7)
    for number in range(2):  # of nothing that the others show
        noise = walls.integers(0, 255, (*shots[0].image.shape[:2], 3), np.uint8)
        Image.fromarray(noise).save(folder / f"x{number}.png")
    (folder / "broken.jpg").write_bytes((folder / "0.jpg").read_bytes()[:500])
    made = make_poses(folder, tmp_path / "poses", Options(), quiet())
    assert len(made.posed) == PHOTOS
    assert sorted(made.without) == ["x0.png", "x1.png"]
    assert [*made.faulty] == ["broken.jpg"]
    assert textured_room.SIZE == (120, 180)


def test_a_photo_of_several_models_is_in_the_largest_alone():
    models = [["a", "b", "c", "d"], ["b", "c"], ["d", "e", "f"], ["e", "g"]]
    assert making.apart(models) == [["a", "b", "c", "d"], ["e", "f"]]


def test_the_summary_says_what_to_do_where_some_have_none_and_what_differs(made):
    few = replace(made, posed=made.posed[1:], without=made.posed[:1])
    assert any("between" in line for line in few.summary)
    assert not any("between" in line for line in made.summary)
    for threads in (1, 2):
        again = replace(made, threads=threads).summary
        assert any("another run" in line for line in again) == (threads > 1)


def test_a_video_gets_poses(shots, tmp_path):
    video = write_video(tmp_path / "phone.mp4", [shot.image for shot in shots])
    made = make_poses(video, tmp_path / "poses", Options(), quiet())
    assert len(made.posed) == PHOTOS
    turn, distance = errors(made.folder, shots)
    assert turn < 1
    assert distance < 0.02
    assert json.loads((made.folder / "poses.json").read_text())["made_by"] == "qgs poses"


REFUSED = {
    "two photos": lambda images: images[:2],
    "one view": lambda images: [images[0]] * 4,
    "bare": lambda images: [np.full_like(image, 127) for image in images],
    "blurred": lambda images: [
        np.array(Image.fromarray(i).resize((12, 8)).resize((540, 360))) for i in images
    ],
    "noise": lambda images: [
        np.random.default_rng(k).integers(0, 255, i.shape, np.uint8) for k, i in enumerate(images)
    ],
    "tiny": lambda images: [image[:10, :10] for image in images],
}


@pytest.mark.parametrize("kind", REFUSED)
def test_hopeless_photos_are_refused(kind, shots, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, image in enumerate(REFUSED[kind]([shot.image for shot in shots[:4]])):
        Image.fromarray(image).save(folder / f"{number}.png")
    with pytest.raises(PosesError):
        make_poses(folder, tmp_path / "poses", Options(), quiet())
    assert not (tmp_path / "poses").exists()


@pytest.mark.slow
def test_turning_on_the_spot_gives_no_poses(from_one_place, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, shot in enumerate(from_one_place):
        Image.fromarray(shot.image).save(folder / f"{number}.png")
    with pytest.raises(PosesError, match="turn on the spot"):
        make_poses(folder, tmp_path / "poses", Options(), quiet())
