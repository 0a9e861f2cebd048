"""Scenes of Kubric's multi-view 4D sets as folders of photos with times, for `qgs/photos`.

    python tools/kubric_to_photos.py KUBRIC/v0 OUT

A scene is a folder of output_000.tar and so on, one a camera, each with metadata.json and
rgba_00000.png and so on, one a time (the layout that TokenGS 2026.6 reads). OUT/SCENE gets RGB
images and a transforms.json whose frames have a `time`; a scene that has one already is left as it
is. Alpha is dropped, as there: what lies behind the objects belongs to the photo. So is depth.
"""

import argparse
import io
import json
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from qgs.files import replacing, write_text
from qgs.geometry.transforms import quat_to_matrix


def camera_frames(tar: Path, out: Path) -> Iterator[dict[str, Any]]:
    """The frames of one camera, whose images are written below `out`."""
    with tarfile.open(tar) as archive:
        members = {member.name.removeprefix("./"): member for member in archive}

        def content(name: str) -> bytes:
            file = archive.extractfile(members[name]) if name in members else None
            if file is None:
                raise SystemExit(f"{tar} has no {name}: download it again")
            return file.read()

        camera = json.loads(content("metadata.json"))["camera"]
        poses = zip(camera["positions"], camera["quaternions"], strict=True)
        for time, (position, quaternion) in enumerate(poses):
            image = Image.open(io.BytesIO(content(f"rgba_{time:05d}.png"))).convert("RGB")
            name = f"images/{tar.stem}_{time:05d}.png"
            with replacing(out / name) as path:
                image.save(path, "PNG")
            yield {
                "file_path": name,
                "time": time,
                "transform_matrix": opengl_pose(position, quaternion).tolist(),
                **intrinsics(camera, image.size),
            }


def opengl_pose(position: list[float], quaternion: list[float]) -> np.ndarray:
    """Camera-to-world (4, 4); x right, y up, z back, as both formats have it."""
    c2w = np.eye(4)
    c2w[:3, :3] = quat_to_matrix(torch.tensor(quaternion, dtype=torch.float64)).numpy()
    c2w[:3, 3] = position
    return c2w


def intrinsics(camera: Mapping[str, Any], size: tuple[int, int]) -> dict[str, float]:
    """In pixels of an image of (W, H) `size`, with square pixels and the axis in the middle."""
    width, height = size
    focal = camera["focal_length"] * width / camera["sensor_width"]
    middle = {"cx": width / 2, "cy": height / 2}
    return {"w": width, "h": height, "fl_x": focal, "fl_y": focal, **middle}


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("scenes", type=Path, help="folder of scenes")
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    scenes = sorted({tar.parent for tar in options.scenes.glob("*/output_*.tar")})
    if not scenes:
        raise SystemExit(f"{options.scenes} holds no folder with files such as output_000.tar")
    for scene in scenes:
        out = options.out / scene.name
        if (out / "transforms.json").exists():
            continue
        (out / "images").mkdir(parents=True, exist_ok=True)
        tars = sorted(scene.glob("output_*.tar"))
        frames = [frame for tar in tars for frame in camera_frames(tar, out)]
        write_text(out / "transforms.json", json.dumps({"frames": frames}, indent=1))
        print(f"{out}: {len(tars)} cameras, {len(frames)} photos")


if __name__ == "__main__":
    main()
