"""Each planted fault is found as exactly one line; the untouched sets pass without any."""

import io
import json
import shutil
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image
from textured_room import INTRINSICS, SIZE, walk
from upath import UPath

from qgs.data.check.dataset import Options, check

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
HASH = "0123456789abcdef" * 4
FRAMES = 6


@pytest.fixture(scope="session")
def shots():
    return walk(FRAMES)


@pytest.fixture(scope="session")
def good(tmp_path_factory, shots):
    """A nerfstudio folder, chunks with two scenes and an index, and an archive, all sound."""
    root = tmp_path_factory.mktemp("good")
    listing = json.dumps(transforms(shots))
    (root / "room" / "images").mkdir(parents=True)
    (root / "room" / "transforms.json").write_text(listing)
    for number, shot in enumerate(shots):
        (root / "room" / "images" / f"{number}.jpg").write_bytes(shot.encoded())
    (root / "chunks" / "test").mkdir(parents=True)
    save(root / "chunks", [record("a", shots), record("b", shots[:3])])
    (root / "chunks" / "test" / "index.json").write_text('{"a": "0.torch", "b": "0.torch"}')
    index = {"a": {"context": [0, 5], "target": [2]}, "b": {"context": [0, 2], "target": [1]}}
    (root / "chunks" / "evaluation.json").write_text(json.dumps(index))
    (root / "archives").mkdir()
    with zipfile.ZipFile(root / "archives" / f"{HASH}.zip", "w") as archive:
        archive.writestr("transforms.json", listing)
        for number, shot in enumerate(shots):
            archive.writestr(f"images/{number}.jpg", shot.encoded())
    return root


def transforms(shots) -> dict:
    fx, fy, cx, cy = INTRINSICS
    top = {"w": SIZE[1], "h": SIZE[0], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    frames = [
        {"file_path": f"images/{number}.jpg", "transform_matrix": (shot.c2w @ FLIP).tolist()}
        for number, shot in enumerate(shots)
    ]
    return {**top, "frames": frames}


def record(key: str, shots) -> dict:
    fx, fy, cx, cy = INTRINSICS
    height, width = SIZE
    rows = [
        [fx / width, fy / height, cx / width, cy / height, 0, 0,
         *np.linalg.inv(shot.c2w)[:3].flatten()]
        for shot in shots
    ]  # fmt: skip
    images = [torch.frombuffer(bytearray(shot.encoded()), dtype=torch.uint8) for shot in shots]
    stamps = torch.arange(len(shots))
    return {
        "key": key, "url": "", "timestamps": stamps,
        "cameras": torch.tensor(rows, dtype=torch.float32), "images": images,
    }  # fmt: skip


def save(root, content) -> None:
    with (root / "test" / "0.torch").open("wb") as file:
        torch.save(content, file)


def told(path, index=(), geometry: int = 0) -> list[str]:
    options = Options(geometry=geometry, threads=2)
    report = check(UPath(path), options, [UPath(file) for file in index])
    return [str(finding) for finding in report.findings]


class Copy:
    """A copy of one of the good sets, to plant faults in."""

    def __init__(self, path):
        self.path = path

    def listing(self, change) -> None:
        file = self.path / "transforms.json"
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))

    def poses(self, change) -> None:
        """Replace every pose (4, 4), given its number."""

        def changed(data):
            for number, frame in enumerate(data["frames"]):
                pose = change(number, np.array(frame["transform_matrix"]))
                frame["transform_matrix"] = pose.tolist()

        self.listing(changed)

    def chunk(self, change) -> None:
        content = torch.load(self.path / "test" / "0.torch", weights_only=True)
        save(self.path, change(content) or content)


@pytest.fixture
def room(good, tmp_path) -> Copy:
    return Copy(shutil.copytree(good / "room", tmp_path / "room"))


@pytest.fixture
def chunks(good, tmp_path) -> Copy:
    return Copy(shutil.copytree(good / "chunks", tmp_path / "chunks"))


@pytest.fixture
def archives(good, tmp_path) -> Copy:
    return Copy(shutil.copytree(good / "archives", tmp_path / "archives"))


@pytest.mark.parametrize("name", ["room", "chunks", "archives"])
def test_untouched_sets_pass(good, name):
    report = check(UPath(good / name), Options(threads=2))
    assert report.findings == []
    assert report.notes == []
    for scene in report.scenes:
        assert scene.geometry.verdict.agrees
        assert scene.geometry.pixels < 0.6
        assert scene.listed == scene.decodable > 0


def test_missing_image(room):
    (room.path / "images" / "2.jpg").unlink()
    assert told(room.path) == [
        "error: room, frame 2 (images/2.jpg): the image does not exist: add the file, or remove "
        "the frame from transforms.json"
    ]


def test_truncated_jpeg(room):
    file = room.path / "images" / "2.jpg"
    file.write_bytes(file.read_bytes()[:-400])
    (line,) = told(room.path)
    assert line.startswith("error: room, frame 2 (images/2.jpg): the image cannot be decoded (")
    assert line.endswith("replace the file, or remove the frame from transforms.json")


def test_truncated_jpeg_in_a_chunk(chunks):
    def cut(content):
        content[0]["images"][4] = content[0]["images"][4][:-400].clone()

    chunks.chunk(cut)
    (line,) = told(chunks.path)
    assert line.startswith("error: a, frame 4 (4): the image cannot be decoded (")
    assert line.endswith("replace the file, or remove the frame from the chunk")


def test_image_of_another_shape(room):
    file = room.path / "images" / "3.jpg"
    Image.open(file).resize((160, 120)).save(file)
    assert told(room.path) == [
        "error: room, frame 3 (images/3.jpg): the image is 160 x 120 pixels, but listed as 180 x "
        "120, another aspect ratio, so that the intrinsics cannot be scaled: give the original "
        "image, or correct the listed size"
    ]


def test_image_of_another_scale_than_the_rest(room):
    file = room.path / "images" / "3.jpg"
    Image.open(file).resize((90, 60)).save(file)
    assert told(room.path) == [
        "error: room, frame 3 (images/3.jpg): the image is 90 x 60 pixels, but listed as 180 x "
        "120, another scale than the rest of the scene: give the original image, or one scaled as "
        "the others"
    ]


def test_listed_size_that_intrinsics_do_not_go_with(room):
    room.listing(lambda data: data.update(w=360, h=240))
    assert told(room.path) == [
        "error: room, frames 0-5 (images/0.jpg to images/5.jpg): the image is 180 x 120 pixels, "
        "but listed as 360 x 240: correct the listed width and height, which the intrinsics do not "
        "go with"
    ]


def test_a_scaled_copy_passes(room):
    room.listing(lambda data: data.update({key: 4 * data[key] for key in data if key != "frames"}))
    (room.path / "images").rename(room.path / "images_4")
    assert told(room.path) == []


def test_width_and_height_swapped(room):
    room.listing(lambda data: data.update(w=SIZE[0], h=SIZE[1]))
    assert told(room.path) == [
        "error: room, frames 0-5 (images/0.jpg to images/5.jpg): the image is 180 x 120 pixels, "
        "but listed as 120 x 180, another aspect ratio, so that the intrinsics cannot be scaled: "
        "width and height are swapped; swap them back"
    ]


def test_sides_swapped_in_a_chunks_intrinsics(chunks):
    def swap(content):
        content[0]["cameras"][:, :4] *= torch.tensor([1.5, 1 / 1.5, 1.5, 1 / 1.5])

    chunks.chunk(swap)
    (line,) = told(chunks.path)
    assert line.startswith("error: a, frames 0-5 (0 to 5): fx and fy differ as if divided by the")
    assert "width and height are swapped; divide fx and cx by the width" in line


def test_opencv_poses_in_a_transforms_json(room):
    room.poses(lambda number, pose: pose @ FLIP)
    (line,) = told(room.path, geometry=1)
    assert line.startswith(
        "error: room, frames 0-5 (images/0.jpg to images/5.jpg): these look like OpenCV poses read "
        "as OpenGL (matches lie "
    )
    assert line.endswith(
        "negate columns 1 and 2 (the camera's y and z axes) of every transform_matrix"
    )


def test_opengl_poses_in_a_chunk(chunks):
    def flip(content):
        w2c = content[0]["cameras"][:, 6:].reshape(-1, 3, 4)
        w2c[:, 1:] *= -1

    chunks.chunk(flip)
    (line,) = told(chunks.path, geometry=1)
    assert line.startswith(
        "error: a, frames 0-5 (0 to 5): these look like OpenGL poses read as OpenCV (matches lie "
    )
    assert line.endswith(
        "negate rows 1 and 2 (the camera's y and z axes) of every world-to-camera matrix"
    )


def test_mirrored_pose(room):
    room.poses(lambda number, pose: pose @ np.diag([-1, 1, 1, 1]) if number == 1 else pose)
    assert told(room.path) == [
        "error: room, frame 1 (images/1.jpg): the pose mirrors and so is not rigid (determinant "
        "-1): negate one axis of the camera, or export the poses again"
    ]


def test_nan_pose(room):
    room.poses(lambda number, pose: pose * np.nan if number == 4 else pose)
    assert told(room.path) == [
        "error: room, frame 4 (images/4.jpg): the pose has NaN or infinite numbers: remove the "
        "frame"
    ]


def test_nan_pose_in_a_chunk(chunks):
    def broken(content):
        content[1]["cameras"][2, 9:] = np.nan

    chunks.chunk(broken)
    assert told(chunks.path) == [
        "error: b, frame 2 (2): the pose has NaN or infinite numbers: remove the frame"
    ]


def test_duplicate_pose(room, shots):
    room.poses(lambda number, pose: shots[2].c2w @ FLIP if number == 5 else pose)
    assert told(room.path) == [
        "error: room, frame 5 (images/5.jpg): the pose repeats that of frame 2 (images/2.jpg), "
        "whose photo is another one: correct the pose, or remove one of the frames"
    ]


def test_a_repeated_photo_is_a_warning(room, shots):
    room.poses(lambda number, pose: shots[2].c2w @ FLIP if number == 5 else pose)
    shutil.copy(room.path / "images" / "2.jpg", room.path / "images" / "5.jpg")
    assert told(room.path) == [
        "warning: room, frame 5 (images/5.jpg): the photo and its pose repeat frame 2 "
        "(images/2.jpg): remove one of the two"
    ]


def test_zero_baseline(room, shots):
    def moved(number, pose):
        pose[:3, 3] = shots[2].c2w[:3, 3] if number == 3 else pose[:3, 3]
        return pose

    room.poses(moved)
    assert told(room.path) == [
        "error: room, frame 3 (images/3.jpg): the camera stands on the same point as that of frame "
        "2 (images/2.jpg), a zero baseline, so that the two tell no depth: correct the position, "
        "or remove one of the frames"
    ]


def test_all_cameras_on_one_point(chunks):
    def centred(content):
        content[0]["cameras"][:, [9, 13, 17]] = 0

    chunks.chunk(centred)
    assert told(chunks.path, geometry=1) == [
        "error: a, frames 0-5 (0 to 5): all 6 cameras stand on one point, so that no depth can be "
        "told: export the poses with their translations"
    ]


def test_principal_point_off_the_image(room):
    room.listing(lambda data: data["frames"][1].update(cx=200.0))
    assert told(room.path) == [
        "error: room, frame 1 (images/1.jpg): the principal point lies off the image (fx 145, fy "
        "147, cx 200, cy 61, 180 x 120 pixels): correct cx and cy, unless the photo is cut from a "
        "larger one"
    ]


def test_normalised_intrinsics_read_as_pixels(room):
    room.listing(lambda data: data.update(fl_x=0.8, fl_y=1.2, cx=0.5, cy=0.5))
    assert told(room.path) == [
        "error: room, frames 0-5 (images/0.jpg to images/5.jpg): the intrinsics look normalised "
        "(fx 0.8, fy 1.2, cx 0.5, cy 0.5): they must be in pixels; multiply fx and cx by the width, "
        "fy and cy by the height"
    ]


def test_pixels_in_a_chunk(chunks):
    def scaled(content):
        content[0]["cameras"][:, :4] *= torch.tensor([180, 120, 180, 120])

    chunks.chunk(scaled)
    assert told(chunks.path) == [
        "error: a, frames 0-5 (0 to 5): the intrinsics (145, 147, 89, 61) look like pixels: chunks "
        "hold fx and cx divided by the image's width, fy and cy by its height"
    ]


def test_index_scene_that_is_absent(chunks, tmp_path):
    index = tmp_path / "wanted.json"
    index.write_text(json.dumps({"nowhere": {"context": [0], "target": [1]}, "b": None}))
    assert told(chunks.path, [index]) == [
        "error: nowhere: the index wanted.json names the scene, which is not there: add the scene, "
        "or take it out of the index; correct the name if it is spelled wrong"
    ]


def test_index_frame_out_of_range(chunks):
    index = {"b": {"context": [0, 2], "target": [3]}}
    (chunks.path / "evaluation.json").write_text(json.dumps(index))
    assert told(chunks.path) == [
        "error: b, frame 3: the index evaluation.json has the target frame 3, but the scene's 3 "
        "frames are 0 to 2: correct the index, or add the missing frames to the scene"
    ]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"key": "a"}, "the file holds a dict, expected a list of mappings"),
        (
            [torch.zeros(2), torch.zeros(2)],
            "2 of its 2 entries are no mappings with a 'key' (the first is a Tensor)",
        ),
    ],
)
def test_chunk_that_is_no_list_of_mappings(chunks, content, reason):
    chunks.chunk(lambda _: content)
    assert told(chunks.path) == [
        f"error: test/0.torch: {reason}; index.json places there 2 scenes: a, b: pack the data set "
        "again with `qgs data pack`, or copy the file again"
    ]


def test_chunk_that_index_json_names_and_that_is_missing(chunks):
    (chunks.path / "test" / "index.json").write_text(
        '{"a": "0.torch", "c": "1.torch", "d": "0.torch"}'
    )
    assert told(chunks.path) == [
        "error: test/1.torch: the chunk does not exist; index.json places there 1 scene: c: "
        "download the chunk, or take its scenes out of index.json",
        "error: d: test/index.json places the scene in 0.torch, which does not hold it: take the "
        "scene out of index.json, or get the chunk that holds it",
        "warning: b: test/0.torch holds the scene, but test/index.json does not name it, so that "
        "it is never read: add it to index.json",
    ]


def test_archive_that_leads_outside(archives):
    file = archives.path / f"{HASH}.zip"
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("../evil.txt", "x")
    assert told(archives.path) == [
        f"error: {HASH}: {file} holds the name '../evil.txt', which leads outside the archive: it "
        "is not read. Get the archive from its publisher again"
    ]


def test_plain_photos_are_not_judged_and_that_is_told(room):
    for number in range(FRAMES):
        shade = (20 * number, 30, 90)
        Image.new("RGB", SIZE[::-1], shade).save(room.path / "images" / f"{number}.jpg")
    assert told(room.path, geometry=1) == [
        "warning: room: the poses are not judged against the photos: too few matches, below 24 in "
        "every pair that was tried: look at the cameras yourself, in the picture that --report "
        "draws"
    ]


def test_what_is_not_done_is_told(good):
    def notes(options):
        return check(UPath(good / "chunks"), options).notes

    assert notes(Options(headers_only=True)) == [
        "quick: only headers of images were read, and no pose was judged by photos"
    ]
    assert notes(Options(geometry=0)) == ["no pose was judged by photos (--geometry 0)"]
    assert notes(Options(geometry=1)) == [
        "poses were judged by photos in 1 of 2 scenes; --geometry 2 judges all"
    ]


def test_masks_that_are_missing_or_damaged(room):
    (room.path / "masks").mkdir()
    (room.path / "masks" / "1.png").write_bytes(b"no image")
    file = io.BytesIO()
    Image.new("L", SIZE[::-1], 255).save(file, "PNG")
    (room.path / "masks" / "2.png").write_bytes(file.getvalue())

    def masked(data):
        for number in (0, 1, 2):
            data["frames"][number]["mask_path"] = f"masks/{number}.png"

    room.listing(masked)
    first, second = told(room.path)
    assert first == (
        "error: room, frame 0 (images/0.jpg): the mask 0.png does not exist: add it, or list no "
        "mask"
    )
    assert second.startswith("error: room, frame 1 (images/1.jpg): ")
    assert "1.png cannot be read as the mask of a photo" in second
