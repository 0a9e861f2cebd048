"""Sound data sets of several formats, and copies of them to plant faults in."""

import json
import shutil

import numpy as np
import photo_formats
import torch
from qgs_datatools.check import Options, check
from qgs_datatools.findings import Finding
from textured_room import INTRINSICS, SIZE
from upath import UPath

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
HASH = "0123456789abcdef" * 4
FRAMES = 6


def photo_set(folder, shots, poses=None) -> photo_formats.PhotoSet:
    """JPEG files of `shots`, and their poses or the given ones."""
    folder.mkdir(parents=True)
    files = tuple(folder / f"{number}.jpg" for number in range(len(shots)))
    for file, shot in zip(files, shots, strict=True):
        file.write_bytes(shot.encoded())
    c2w = np.stack([shot.c2w for shot in shots] if poses is None else poses)
    return photo_formats.PhotoSet(files, c2w, INTRINSICS, SIZE)


def good_sets(root, shots) -> None:
    """A nerfstudio folder, chunks with two scenes and an index, and an archive, all sound."""
    photo_formats.write_nerfstudio(root / "room", photo_set(root / "shots", shots))
    shutil.make_archive(str(root / "archives" / HASH), "zip", root / "room")
    (root / "chunks" / "test").mkdir(parents=True)
    save(root / "chunks", [record("a", shots), record("b", shots[:3])])
    (root / "chunks" / "test" / "index.json").write_text('{"a": "0.torch", "b": "0.torch"}')
    index = {"a": {"context": [0, 5], "target": [2]}, "b": {"context": [0, 2], "target": [1]}}
    (root / "chunks" / "evaluation.json").write_text(json.dumps(index))


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


def findings(path, index=(), geometry: int = 1) -> list[Finding]:
    options = Options(geometry=geometry, threads=2)
    return check(UPath(path), options, [UPath(file) for file in index]).findings


def told(path, index=(), geometry: int = 1) -> list[str]:
    return [str(finding) for finding in findings(path, index, geometry)]


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
        changed = change(content)
        save(self.path, content if changed is None else changed)
