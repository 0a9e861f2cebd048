"""Files of a reconstruction: PLY, pictures of all views, an orbit as GIF, cameras.json."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from qgs.drawing import images
from qgs.drawing.figures import figure_picture, grid_figure
from qgs.drawing.images import Picture, depth_picture, depth_range, rgb_picture
from qgs.files import replacing_entries, write_text
from qgs.geometry.poses import look_at, mean_camera
from qgs.metrics.images import Psnr
from qgs.reconstruction.result import Reconstruction, sample_cameras
from qgs.reconstruction.scene_formats import save_gaussians, save_ply, writer_of
from qgs.types import Cameras

ORBIT_FRAMES = 24
ORBIT_SIDE = 320
SWAY = 0.12
"""Sideways motion of an orbit, as a fraction of the depth of the scene."""
OVERVIEW_COLUMNS = 8


def orbit(inputs: Cameras, depth: float, frames: int) -> Cameras:
    """Return cameras (1, frames) on a smooth loop past the input cameras (1, V).

    The loop sways sideways by SWAY times `depth`, and looks at points at this depth.
    """
    angles = torch.arange(frames, device=inputs.c2w.device) * (2 * math.pi / frames)
    count = inputs.shape[1]
    # From 0, the first input, to count - 1, the last, and back.
    times_T = (1 - angles.cos()) / 2 * (count - 1)
    distances_TV = times_T[:, None] - torch.arange(count, device=times_T.device)
    # A smooth mean of neighbouring inputs, so that the path has no corner at any of them.
    weights_TV = torch.softmax(-0.5 * (distances_TV / 0.6) ** 2, -1)
    mean = torch.einsum("tv,vij->tij", weights_TV, inputs.c2w[0])
    # A mean of rotations is no rotation: its axes are made orthonormal again.
    right, down, forward, centre = mean_camera(mean[:, None])[:, :3].unbind(-1)
    reach = SWAY * depth
    eye = centre + reach * angles.sin()[:, None] * right
    eye = eye - reach / 2 * angles.cos()[:, None] * down
    c2w = look_at(eye, centre + depth * forward - eye, down)
    return Cameras(c2w[None], inputs.intrinsics[:, :1].expand(1, frames, 4), inputs.size)


def write_reconstruction(result: Reconstruction, out: Path) -> list[Path]:
    """Write gaussians.ply, overview.png, views/, depth/, orbit.gif and cameras.json into `out`.

    These files are in the model's world; cameras.json has the transform to the photos' world. The
    files of an earlier result are replaced together, once all new files are complete. Raises
    FileExistsError if `out` holds some of these files, but no gaussians.ply.
    If `out` has the suffix of a scene format (.ply, .splat, ...), only this file is written, with
    the Gaussians in the photos' world.
    """
    # A file holds Gaussians alone, so they are in the world of the photos.
    if writer_of(out):
        save_gaussians(result.in_photos_world, out, result.input_cameras)
        return [out]
    middle = sum(depth_range(result.rendering.depth)) / 2
    path = images.finer(orbit(result.sample.inputs.cameras, middle, ORBIT_FRAMES), ORBIT_SIDE)
    # Rendered before the folder is touched: an earlier result stays where this fails.
    with torch.no_grad():
        frames = result.model.render(result.gaussians, path).rgb[0]
    rows = _pictures(result)
    with replacing_entries(out, "gaussians.ply") as fresh:
        save_ply(result.gaussians, fresh / "gaussians.ply")
        for i, score in enumerate(result.scores):
            name = f"{score.frame:05d}_{score.kind.split()[0]}.png"
            pair = images.side_by_side([rows["photo"][i], rows["render"][i]])
            images.write_png(pair, fresh / "views" / name)
            images.write_png(rows["depth"][i], fresh / "depth" / name)
        images.write_png(overview(result), fresh / "overview.png")
        images.write_gif([rgb_picture(f) for f in frames], fresh / "orbit.gif")
        write_text(fresh / "cameras.json", json.dumps(_camera_record(result, path), indent=1))
        names = sorted(entry.name for entry in fresh.iterdir())
    return [out / name for name in names]


def _pictures(result: Reconstruction) -> dict[str, list[Picture]]:
    """Return the pictures of all views by kind: "photo", "render" and "depth"."""
    sample = result.sample
    rendering = result.rendering
    near, far = depth_range(rendering.depth)
    photos = (*sample.inputs.images[0], *sample.targets.images[0])
    return {
        "photo": [rgb_picture(image) for image in photos],
        "render": [rgb_picture(image) for image in rendering.rgb[0]],
        "depth": [depth_picture(depth, near, far) for depth in rendering.depth[0]],
    }


def overview(result: Reconstruction) -> Picture:
    """Draw rows of photos, renderings and depths of the first OVERVIEW_COLUMNS scored views."""
    scores = result.scores
    # Inputs come first in `scores`, so they stay where the row is too long.
    shown = sorted(range(min(len(scores), OVERVIEW_COLUMNS)), key=lambda i: scores[i].frame)
    titles = []
    for index in shown:
        score = scores[index]
        quality = f"{Psnr.column.shown(score.psnr)} {Psnr.column.unit}"
        titles.append(
            f"frame {result.sample.short_label(score.frame)}\n{score.kind.split()[0]}, {quality}"
        )
    rows = {
        kind: [pictures[index] for index in shown] for kind, pictures in _pictures(result).items()
    }
    figure = grid_figure(rows, titles, depth_range(result.rendering.depth))
    return figure_picture(figure)


def _camera_record(result: Reconstruction, path: Cameras) -> dict[str, Any]:
    reference, scale = result.sample.world
    cameras = _plain(sample_cameras(result.sample))
    views = [
        {
            "frame": score.frame,
            "photo": result.sample.names.get(score.frame),
            "kind": score.kind,
            "psnr": round(score.psnr, 3),
            **camera,
        }
        for score, camera in zip(result.scores, cameras, strict=True)
    ]
    model = result.model
    count = model.queries.count
    return {
        "convention": "OpenCV camera-to-world; intrinsics fx, fy, cx, cy in pixels; size H, W",
        "scene": result.sample.scene,
        "model": model.loaded_from,
        "gaussians": count and count * model.head.gaussians_per_query,
        "tuning": result.tuning,
        "remarks": result.remarks,
        "refinement": result.refinement,
        "background": model.renderer.config.background,
        "to_photos": {
            "rule": "point p of this world is reference_c2w applied to p / scale in photos' world",
            "reference_c2w": reference.tolist(),
            "scale": float(scale),
            "search": result.scale and asdict(result.scale),
        },
        "views": views,
        "orbit": _plain(path),
    }


def _plain(cameras: Cameras) -> list[dict[str, Any]]:
    pairs = zip(cameras.c2w[0].tolist(), cameras.intrinsics[0].tolist(), strict=True)
    return [
        {"c2w": c2w, "intrinsics": intrinsics, "size": cameras.size} for c2w, intrinsics in pairs
    ]
