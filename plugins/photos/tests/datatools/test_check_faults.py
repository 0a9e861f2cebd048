"""Each planted fault is found as exactly one line; the untouched sets pass without any."""

import os

import numpy as np
import torch
from photo_formats import encoded
from PIL import Image
from planted import ALL, HASH, INTRINSICS, SIZE, assert_told, checked, record, save
from tables import must_not_find
from upath import UPath

from qgs.data.photos import present_frames

FX, FY, CX, CY = INTRINSICS
OPENGL = [1, -1, -1, 1]


def test_untouched_sets_pass(good):
    for name in ("room", "chunks", "archives"):
        report = checked(good / name)
        assert not report.findings
        for scene in report.scenes:
            assert float(scene.epipolar) < 0.6
            assert scene.listed == scene.decodable > 0


def test_faults_of_files(planted, shots):
    missing = planted("error: images/2.jpg: *does not exist*")
    del missing.files["images/2.jpg"]
    cut = planted("error: frame 2 (images/2.jpg): *cannot be decoded*")
    cut.files["images/2.jpg"] = cut.files["images/2.jpg"][:-400]
    pipe = planted("error: frame 2 (images/2.jpg): *is a pipe*")
    del pipe.files["images/2.jpg"]
    (planted.root / "room 02/images").mkdir(parents=True)
    os.mkfifo(planted.root / "room 02/images/2.jpg")

    wide = "error: frame 3 (images/3.jpg): *160 x 120 pixels, but listed as 180 x 120, another *"
    small = Image.fromarray(shots[3].image).resize((160, 120))
    planted(wide).files["images/3.jpg"] = encoded(small, "JPEG")
    swapped = f"error: {ALL}*180 x 120 pixels, but listed as 120 x 180*swapped*"
    planted(swapped).camera.update(w=120, h=180)

    scaled_copy = planted()
    for key in scaled_copy.camera:
        scaled_copy.camera[key] *= 4
    for name in [*scaled_copy.files]:
        scaled_copy.files[name.replace("images", "images_4")] = scaled_copy.files.pop(name)
    planted.check()


def test_faults_of_cameras(planted):
    planted(f"error: {ALL}the poses do not fit the photos: *check the convention*").poses *= OPENGL
    planted("error: frame 1 (images/1.jpg): the pose is mirrored*").poses[1, :, 0] *= -1
    off = planted("error: frame 1 (images/1.jpg): the intrinsics *are implausible*")
    off.frames[1]["cx"] = 200.0
    normalised = {"fl_x": 0.8, "fl_y": 1.2, "cx": 0.5, "cy": 0.5}
    planted(f"error: {ALL}*look normalised*").camera |= normalised

    repeats = "frame 5 (images/5.jpg): the {}pose repeat* frame 2 (images/2.jpg)*"
    same_pose = planted(f"error: {repeats.format('')}")
    same_photo = planted(f"warning: {repeats.format('photo and its ')}")
    same_photo.files["images/5.jpg"] = same_photo.files["images/2.jpg"]
    for room in (same_pose, same_photo):
        room.poses[5] = room.poses[2]

    same_point = (
        "error: frame 3 (images/3.jpg): the camera stands on the same point as that of frame 2 "
        "(images/2.jpg): *"
    )
    far = planted()
    far_too = planted(same_point)
    for room in (planted(same_point), far_too):
        room.poses[3, :3, 3] = room.poses[2, :3, 3]
    for room in (far, far_too):
        room.poses[:, :3, 3] += [2e5, 3e5, 100]  # metres of a map's grid
    planted.check()


def test_faults_that_several_frames_show_together(planted, shots):
    two = "frames 1, 4 (images/1.jpg to images/4.jpg): "
    fit = "the pose or the intrinsics do not fit *"
    both = planted(f"error: {two}{fit}")
    both.poses[[1, 4]] = both.poses[[4, 1]]
    planted(f"error: frame 3 (images/3.jpg): {fit}").poses[3, 1, 3] += 0.3
    misfit = f"*: {ALL}the poses do not fit the photos: matches lie *pixels from their *"
    planted(misfit).camera.update(fl_x=1.3 * FX, fl_y=1.3 * FY)
    planted(misfit).camera.update(cx=CY, cy=CX)
    planted(misfit).camera.update(w=360, h=240)
    cut = planted(misfit)
    cut.camera["w"] -= 45
    black = planted("error: frame 2 (images/2.jpg): the image is black*")
    plain = planted(
        "warning: *: the poses are not checked against the photos: too few matches, below 24 in "
        "every pair that was tried: look at the cameras yourself"
    )

    def put(room, number, pixels):
        room.files[f"images/{number}.jpg"] = encoded(pixels, "JPEG", quality=92, subsampling=0)

    for number, shot in enumerate(shots):
        put(cut, number, shot.image[:, 45:])
        put(plain, number, 0 * shot.image + np.uint8([20 * number, 30, 90]))
    put(black, 2, 0 * shots[2].image)
    planted.check()


def test_faults_of_masks(planted, shots):
    masks = np.zeros((6, *SIZE), np.uint8)
    planted(f"error: {ALL}the mask is black*").mask(masks)
    masks[[0, 1, 3, 4, 5], 40:] = 255
    planted("warning: frame 2 (images/2.jpg): the mask is black*").mask(masks)
    damaged = planted(
        "error: frame 0 (images/0.jpg): *masks/0.png cannot be read*",
        "error: frame 1 (images/1.jpg): *masks/1.png cannot be read*",
    )
    masks[2] = 255
    damaged.mask(masks)
    del damaged.files["masks/0.png"]
    damaged.files["masks/1.png"] = b"no image"
    swapped = planted("warning: frames 1, 4 *: the mask fits another photo better*")
    for number, shot in enumerate(shots):
        thing = np.s_[30:60, 20 * number : 20 * number + 30]
        image = shot.image.copy()
        image[thing] = 255
        masks[number] = 0
        masks[number][thing] = 255
        swapped.files[f"images/{number}.jpg"] = encoded(image, "JPEG")
    swapped.mask(masks[[0, 4, 2, 3, 1, 5]])
    planted.check()


def test_a_camera_that_stands_still_may_film_what_moves(planted):
    """Two frames have one pose; times tell them apart, but are wrong in the last room."""
    repeats = "error: frame 5 (images/5.jpg): the pose repeats *"
    wrong = ["error: *gives 'time' only for some frames, not for images/4.jpg, images/5.jpg:*"]
    cases = (([], [repeats]), ([0.5] * 6, [repeats]), (range(6), []), ([0, 1, "2", 3], wrong))
    for times, lines in cases:
        room = planted(*lines)
        room.poses[5] = room.poses[2]
        for frame, time in zip(room.frames, times, strict=False):
            frame["time"] = time
    planted.check(geometry=0)


def test_photos_have_one_number_in_reading_and_in_checking(planted, caplog):
    """Behind a photo that is missing, the number in a message is the one that `--frames` takes."""
    nan = "error: frame 2 (images/3.jpg): the pose has NaN*"
    room = planted("error: images/1.jpg: the image does not exist*", nan)
    del room.files["images/1.jpg"]
    room.poses[3] = np.nan
    planted.check()
    present, _ = present_frames(UPath(planted.root / "room 00"))
    assert "frame 2 (images/3.jpg): the pose has NaN" in caplog.text
    assert len(present) == 4


def test_faults_of_a_scene_in_a_chunk(shots, tmp_path):
    nan, point, cut, opengl, swapped, pixels = records = [record(key, shots) for key in "abcdef"]
    nan["cameras"][2, 9:] = np.nan
    point["cameras"][:, [9, 13, 17]] = 0
    cut["images"][4] = cut["images"][4][:-400].clone()
    opengl["cameras"][:, 10:] *= -1
    swapped["cameras"][:, :4] *= torch.tensor([1.5, 1 / 1.5] * 2)
    pixels["cameras"][:, :4] *= torch.tensor([180, 120] * 2)
    save(tmp_path / "test/0.torch", records)
    expected = (
        "error: a, frame 2 (2000): the pose has NaN*",
        "error: b, frames 0-5 (0 to 5000): *on one point*",
        "error: c, frame 4 (4000): the image cannot be decoded*",
        "error: d, frames 0-5 (0 to 5000): the poses do not fit the photos: *",
        "error: e, frames 0-5 (0 to 5000): *are implausible*",
        "error: f, frames 0-5 (0 to 5000): *look like pixels*",
    )
    assert_told(tmp_path, expected, geometry=6)


def test_faults_of_chunks_and_their_index(chunks):
    """0 is sound but for its index, 1 is missing, and 2 to 4 hold no scenes."""
    index = '{"a": "0.torch", "c": "1.torch", "d": "0.torch", "e": "2.torch", "f": "3.torch"}'
    (chunks / "test/index.json").write_text(index)
    save(chunks / "test/2.torch", {"key": "e"})
    save(chunks / "test/3.torch", [torch.zeros(2)] * 2)
    save(chunks / "test/4.torch", [])
    expected = (
        "error: test/2.torch: *",
        "error: test/3.torch: 0 of its 2 entries are mappings with a 'key'*",
        "error: test/4.torch: 0 of its 0 entries *: pack the data set again*",
        "error: test/1.torch: index.json lists for this file 1 scene *: c: copy the chunk again*",
        "error: test/0.torch: index.json lists for this file 1 scene that it does not hold: d: *",
        "error: test/2.torch: index.json lists for this file 1 scene that it does not hold: e: *",
        "error: test/3.torch: index.json lists for this file 1 scene that it does not hold: f: *",
        "warning: test/index.json: the index does not name b, so that no reader *",
    )
    assert_told(chunks, expected, geometry=0)


def test_an_index_is_checked_where_it_is_given_and_where_it_lies_with_the_chunks(chunks):
    given = UPath(chunks.with_name("given.json"))
    for file in (given, chunks / "evaluation.json"):
        file.write_text(
            '{"nowhere": {"context": [0], "target": [1]}, "a": null, '
            '"b": {"context": [0, 2], "target": [3]}}'
        )
    expected = (
        "error: nowhere: the index given.json *does not exist*",
        "error: b: the index given.json has frames 3, but the scene has 0 to 2*",
        "error: nowhere: the index evaluation.json *does not exist*",
        "error: b: the index evaluation.json has frames 3, but the scene has 0 to 2*",
    )
    assert_told(chunks, expected, [given], geometry=0)


def test_other_data_sets_beside_scenes_are_named(room, chunks):
    line = f"warning: chunks: the folder lists no cameras*`qgs data check {chunks}`*"
    assert_told(room.parent, [line])


def test_single_files_are_data_sets_too(good):
    for file, held in (
        (f"archives/{HASH}.zip", [HASH]),
        ("chunks/test/0.torch", ["a", "b"]),
        ("room/transforms.json", ["room"]),
    ):
        assert [scene.name for scene in checked(good / file, headers_only=True).scenes] == held


def test_nothing_passes_in_silence(good):
    room = UPath(good / "room")
    absent = "holds no data of the format chunks: leave --format out"
    must_not_find(absent, checked, room, format="chunks")
    must_not_find("no evaluation index at", checked, room, [room / "none.json"], geometry=0)
