"""Faults that no frame shows by itself are found by what its photos and the other ones share."""

import numpy as np
import pytest
from PIL import Image, ImageDraw
from planted import FRAMES, findings
from qgs_datatools.epipolar import Pair
from qgs_datatools.suspects import frames_off
from textured_room import INTRINSICS, SIZE, walk

FX, FY, CX, CY = INTRINSICS
ALL = tuple(range(FRAMES))


def exchanged(room):
    poses = {}
    room.poses(lambda number, pose: poses.setdefault(number, pose))
    room.poses(lambda number, pose: poses[{1: 4, 4: 1}.get(number, number)])


def listed(**values):
    return lambda room: room.listing(lambda data: data.update(values))


def pictures(change, *numbers):
    def changed(room):
        for number in numbers or range(FRAMES):
            file = room.path / "images" / f"{number}.jpg"
            pixels = change(np.array(Image.open(file)))
            Image.fromarray(np.ascontiguousarray(pixels)).save(file, quality=92, subsampling=0)

    return changed


def cut(room):
    pictures(lambda pixels: pixels[:, 45:])(room)
    room.listing(lambda data: data.update(w=SIZE[1] - 45))


FAULTS = {
    "exchanged poses": (exchanged, (1, 4), "error", "exchanged"),
    "focal length": (listed(fl_x=1.3 * FX, fl_y=1.3 * FY), ALL, "error", "focal lengths"),
    "cx and cy": (listed(cx=CY, cy=CX), ALL, "error", "cx and cy"),
    "cut photos": (cut, ALL, "error", "intrinsics"),
    "BGR": (pictures(lambda pixels: pixels[..., ::-1], 1, 3, 5), (1, 3, 5), "warning", "blue"),
    "black photo": (pictures(np.zeros_like, 2), (2,), "error", "black"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_of_a_scene(room, fault):
    change, frames, severity, word = FAULTS[fault]
    change(room)
    (found,) = findings(room.path)
    assert (found.frames, found.severity) == (frames, severity)
    assert word in found.reason


def projected(points, c2w) -> np.ndarray:
    """Pixels (P, 2) of points (P, 3) of the world."""
    x, y, z = ((points - c2w[:3, 3]) @ c2w[:3, :3]).T
    return np.stack([FX * x / z + CX, FY * y / z + CY], -1)


def poster(shot) -> np.ndarray:
    """A mask that is white on a part of the wall at z = 1.5."""
    corners = np.array([[-0.5, -0.4, 1.5], [0.5, -0.4, 1.5], [0.5, 0.4, 1.5], [-0.5, 0.4, 1.5]])
    mask = Image.new("L", SIZE[::-1])
    ImageDraw.Draw(mask).polygon([*map(tuple, projected(corners, shot.c2w))], fill=255)
    return np.array(mask)


MASKS = {
    "sound": (lambda masks: masks, None, None, None),
    "black": (lambda masks: 0 * masks, ALL, "error", "black"),
    "white": (lambda masks: 0 * masks + 255, ALL, "warning", "white"),
    "inverted": (lambda masks: 255 - masks, ALL, "warning", "inverted"),
    "of the next frame": (lambda masks: np.roll(masks, -1, 0), ALL[:-1], "warning", "next"),
    "one black": (
        lambda masks: masks * (np.arange(FRAMES) != 2).astype(np.uint8)[:, None, None],
        (2,),
        "warning",
        "black",
    ),
    "one inverted": (
        lambda masks: masks ^ (255 * (np.arange(FRAMES) == 2)).astype(np.uint8)[:, None, None],
        (2,),
        "warning",
        "inverted",
    ),
}


@pytest.mark.parametrize("fault", MASKS)
def test_fault_of_masks(room, shots, fault):
    change, frames, severity, word = MASKS[fault]
    (room.path / "masks").mkdir()
    for number, mask in enumerate(change(np.stack([poster(shot) for shot in shots]))):
        Image.fromarray(mask).save(room.path / "masks" / f"{number}.png")
    names = [f"masks/{number}.png" for number in range(FRAMES)]
    room.listing(
        lambda data: [
            frame.update(mask_path=name) for frame, name in zip(data["frames"], names, strict=True)
        ]
    )
    found = findings(room.path)
    assert [(one.frames, one.severity) for one in found] == ([(frames, severity)] if word else [])
    assert all(word in one.reason for one in found)


def test_a_frame_is_off_where_all_its_partners_say_so():
    rng, shots = np.random.default_rng(0), walk(FRAMES)
    shots[3].c2w[:3, 3] += [0.0, 0.3, 0.0]
    points = rng.uniform([-1, -1, 1], [1, 1, 3], (40, 3))
    seen = [projected(points, shot.c2w) for shot in walk(FRAMES)]
    pairs = [
        Pair(
            (one, two), np.stack([seen[one], seen[two]]), np.zeros((2, 40, 3)),
            np.stack([shots[one].c2w, shots[two].c2w]), np.array([INTRINSICS] * 2), SIZE,
        )
        for one in range(FRAMES) for two in range(one + 1, FRAMES)
    ]  # fmt: skip
    assert frames_off(pairs, 0.005) == [3]
