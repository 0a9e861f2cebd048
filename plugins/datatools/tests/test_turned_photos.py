"""Photos whose EXIF turns them: their cameras turn with them."""

import json

import numpy as np
import pytest
import torch
from photo_formats import encoded, opened, scene
from PIL import Image
from qgs_datatools.check import Options, check
from qgs_datatools.entries import Encoding, encoded_frames
from textured_room import INTRINSICS, SIZE, walk
from upath import UPath

ORIENTATION = 0x0112
STORED = {
    6: Image.Transpose.ROTATE_90,
    8: Image.Transpose.ROTATE_270,
    3: Image.Transpose.ROTATE_180,
}
"""How an upright photo is stored under each orientation."""
LENS = {"k1": 0.05, "p1": 0.004, "p2": -0.003}


def stored_camera(orientation: int, c2w: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    """The camera of the stored pixels of an upright photo, by angles rather than by quarters."""
    angle = {6: np.pi / 2, 8: -np.pi / 2, 3: np.pi}[orientation]
    cosine, sine = np.cos(angle), np.sin(angle)
    # stored axes in upright ones: turning the picture clockwise by `angle` makes it upright
    axes = np.eye(4)
    axes[:2, :2] = [[cosine, -sine], [sine, cosine]]
    fx, fy, cx, cy = INTRINSICS
    height, width = SIZE
    if orientation == 3:
        return c2w @ axes, {"fl_x": fx, "fl_y": fy, "cx": width - cx, "cy": height - cy,
                            "w": width, "h": height}  # fmt: skip
    x, y = (cy, width - cx) if orientation == 6 else (height - cy, cx)
    return c2w @ axes, {"fl_x": fy, "fl_y": fx, "cx": x, "cy": y, "w": height, "h": width}


def written(folder, orientation: int, listed: str):
    """A walk as stored photos. listed: of which pixels the cameras are, "stored" or "upright"."""
    folder.mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    frames, shots = [], walk(4)
    for number, shot in enumerate(shots):
        image = Image.fromarray(shot.image).transpose(STORED[orientation])
        (folder / f"{number}.png").write_bytes(encoded(image, exif=exif))
        fx, fy, cx, cy = INTRINSICS
        camera = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": SIZE[1], "h": SIZE[0]}
        pose = shot.c2w
        if listed == "stored":
            pose, camera = stored_camera(orientation, pose)
        matrix = (pose @ np.diag([1.0, -1, -1, 1])).tolist()
        frames.append({"file_path": f"{number}.png", "transform_matrix": matrix, **camera})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder, shots


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("listed", ["stored", "upright"])
def test_cameras_and_pixels_are_the_upright_ones(tmp_path, orientation, listed):
    if orientation == 3 and listed == "upright":
        pytest.skip("nothing tells a half turn: cameras are those of the stored pixels")
    folder, shots = written(tmp_path / "a", orientation, listed)
    read = scene(folder, SIZE)
    expected = torch.from_numpy(np.stack([shot.c2w for shot in shots]))
    torch.testing.assert_close(read.cameras.c2w, expected)
    torch.testing.assert_close(
        read.cameras.intrinsics, torch.tensor(INTRINSICS).double().expand(4, 4)
    )
    image = read.images([1])[0].permute(1, 2, 0).mul(255).round().byte().numpy()
    np.testing.assert_array_equal(image, shots[1].image)
    assert read.stored_size(0) == SIZE
    report = check(UPath(folder), Options(threads=1))
    assert not report.errors
    (judged,) = report.scenes
    assert judged.geometry.pixels < 1


def test_a_lens_turns_with_its_photo(tmp_path):
    folder, _ = written(tmp_path / "a", 6, "stored")
    listing = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({**listing, **LENS}))
    source = opened(folder, SIZE)
    (plain,) = (s.images([0])[0] for s in source.scenes("train"))
    for number in range(4):  # the same pixels, stored upright
        path = folder / f"{number}.png"
        image = Image.open(path).transpose(Image.Transpose.ROTATE_270)
        image.save(path)
    fx, fy, cx, cy = INTRINSICS
    camera = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": SIZE[1], "h": SIZE[0]}
    # the tangential part (p2, p1) is a vector in the image: x to y, y to -x
    upright = {"k1": LENS["k1"], "p1": LENS["p2"], "p2": -LENS["p1"]}
    frames = [{**frame, **camera} for frame in listing["frames"]]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, **upright}))
    turned = scene(folder, SIZE).images([0])[0]
    torch.testing.assert_close(plain, turned, atol=1.5 / 255, rtol=0)


def test_packed_photos_are_upright(tmp_path):
    folder, shots = written(tmp_path / "a", 8, "stored")
    (frame, kept), *_ = encoded_frames(scene(folder, SIZE), Encoding())
    assert frame.size == SIZE
    np.testing.assert_allclose(frame.c2w, shots[0].c2w, atol=1e-12)
    path = tmp_path / "packed.png"
    path.write_bytes(frame.data)
    np.testing.assert_array_equal(np.array(Image.open(path)), shots[0].image)
    assert kept == (not Image.open(path).getexif().get(ORIENTATION))
