"""Sound data sets of several formats, and scenes to plant faults in."""

import json
from fnmatch import fnmatchcase

import numpy as np
import torch
from photo_formats import encoded, listed_lens, opengl, put
from qgs_photos.datatools.check import Options, check
from textured_room import INTRINSICS, SIZE
from upath import UPath

HASH = "0123456789abcdef" * 4
ALL = "frames 0-5 (images/0.jpg to images/5.jpg): "


class Room:
    """What is written of a nerfstudio folder. poses: OpenCV. files: bytes by name."""

    def __init__(self, shots):
        self.files = {f"images/{n}.jpg": shot.encoded() for n, shot in enumerate(shots)}
        self.frames = [{"file_path": name} for name in self.files]
        self.poses = np.stack([shot.c2w for shot in shots])
        self.camera = listed_lens(*INTRINSICS, *SIZE)

    def mask(self, masks):
        for number, mask in enumerate(masks):
            self.files[f"masks/{number}.png"] = encoded(mask)
            self.frames[number]["mask_path"] = f"masks/{number}.png"

    def write(self, folder):
        for frame, pose in zip(self.frames, opengl(self.poses), strict=True):
            frame["transform_matrix"] = pose
        listing = json.dumps({**self.camera, "frames": self.frames})
        for name, data in {**self.files, "transforms.json": listing.encode()}.items():
            put(folder / name, data)
        return folder


class Planted:
    """Rooms, each with a fault, and the lines that are told of it, without the room's name."""

    def __init__(self, shots, root):
        self.shots = shots
        self.root = root
        self.rooms = {}

    def __call__(self, *lines):
        room = Room(self.shots)
        self.rooms[room] = lines
        return room

    def check(self, geometry=99):
        """All rooms at once."""
        for number, room in enumerate(self.rooms):
            room.write(self.root / f"room {number:02}")
        report = checked(self.root, geometry=geometry)
        assert not report.general
        for scene, lines in zip(report.scenes, self.rooms.values(), strict=True):
            found = [str(f).replace(f"{scene.name}, ", "") for f in scene.findings]
            assert alike(found, lines), (lines, found)


def alike(lines, patterns):
    """Whether these are the lines of the patterns, and no others."""
    return len(lines) == len(patterns) and all(map(fnmatchcase, lines, patterns))


def checked(path, index=(), **options):
    return check(UPath(path), Options(**options), index)


def assert_told(path, patterns, index=(), geometry=1):
    found = [*map(str, checked(path, index, geometry=geometry).findings)]
    assert alike(found, patterns), found


def as_tensor(data):
    return torch.frombuffer(bytearray(data), dtype=torch.uint8)


def entry(key, lens, poses, images):
    """A scene of a chunk. lens: in parts of the sides. images: files as tensors."""
    cameras = [[*lens, 0, 0, *np.linalg.inv(c2w)[:3].flatten()] for c2w in poses]
    return {
        "key": key,
        "url": "",
        "timestamps": torch.arange(len(images)) * 1000,
        "cameras": torch.tensor(cameras, dtype=torch.float32),
        "images": images,
    }


def record(key, shots):
    lens = np.array(INTRINSICS) / (SIZE[::-1] * 2)
    images = [as_tensor(shot.encoded()) for shot in shots]
    return entry(key, lens, [shot.c2w for shot in shots], images)


def save(chunk, content):
    chunk.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content, chunk)
