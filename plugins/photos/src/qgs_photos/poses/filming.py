"""Render videos of Gaussians along a camera path, as mp4 or WebP."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.progress import track

from qgs.contracts import Renderer
from qgs.data.images import CropResize
from qgs.data.samples import in_world
from qgs.drawing.images import rgb_picture
from qgs.files import replacing
from qgs.geometry.poses import scaled
from qgs.reconstruction.scene_formats import load_ply
from qgs.reconstruction.scenes import photo_scene
from qgs.renderers import AutoRenderer
from qgs.types import Cameras, Gaussians, Size, World
from qgs_photos.poses.paths import KINDS, focal_length, path_of, read_path
from qgs_photos.record import GAUSSIANS, factor_of, has_record, read_record
from qgs_photos.viewing import VIEWER, in_own_world

SUFFIXES = (".mp4", ".webp")
# Of x264; 0 loses nothing, 23 is its default.
_QUALITY = "18"
# Pixels of the shorter side, where the photos have fewer.
_HEIGHT = 480


class FilmScene(NamedTuple):
    """Gaussians (1, G) and the cameras (1, V) of the scene's photos, in the same world.

    world: the reference pose (4, 4) and the scale that map the photos' world frame to that of the
    Gaussians, see `own_world`.
    """

    gaussians: Gaussians
    cameras: Cameras
    renderer: Renderer
    world: World


@torch.no_grad()
def film(scene: FilmScene, path: Cameras, file: Path, rate: int, console: Console) -> None:
    """Render a scene from the cameras (1, T) of a path of T frames, and write a video.

    rate: frames per second.
    """
    path = path.to(scene.gaussians.means.device)
    frames = range(path.shape[1])
    hidden = not console.is_terminal
    places = track(frames, "rendering", console=console, transient=True, disable=hidden)
    rendered = (scene.renderer(scene.gaussians, path[:, [place]]) for place in places)
    write_film((rgb_picture(each.rgb[0, 0]) for each in rendered), file, rate)


def write_film(frames: Iterator[np.ndarray], file: Path, rate: int) -> None:
    """Write a video: H.264 in mp4, or an animated WebP that repeats forever.

    frames: pictures of one size. rate: frames per second.
    """
    refuse_suffix(file)
    with replacing(file) as temporary:
        if file.suffix.lower() == ".webp":
            first, *rest = map(Image.fromarray, frames)
            options = {"duration": round(1000 / rate), "loop": 0, "quality": 85, "method": 2}
            first.save(temporary, "WEBP", save_all=True, append_images=rest, **options)
        else:
            _write_mp4(frames, temporary, rate)


def refuse_suffix(file: Path) -> None:
    """Raise ValueError unless the name of `file` ends with .mp4 or .webp."""
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{file} cannot be a video: its name must end in {' or '.join(SUFFIXES)}")


def _write_mp4(frames: Iterator[np.ndarray], path: Path, rate: int) -> None:
    # browsers show it before all is there
    options = {"movflags": "+faststart"}
    with av.open(str(path), "w", format="mp4", options=options) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": _QUALITY})
        stream.pix_fmt = "yuv420p"
        for number, picture in enumerate(frames):
            # its colours have half the resolution
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
            if not number:
                stream.height, stream.width = even.shape[:2]
            frame = av.VideoFrame.from_ndarray(even, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def cameras_of(
    scene: FilmScene, path: str, size: Size | None, frames: int, fov: float | None
) -> Cameras:
    """Return the cameras (1, T) of a camera path of T frames.

    path: orbit, spiral, walk, or the name of a file. size: (H, W) of the video in pixels; None
    takes that of the photos. frames: T, unless `path` is a file. fov: vertical angle of view in
    degrees; None takes that of the photos or the file. Raises ValueError for a file that is not a
    camera path.
    """
    size = size or _film_size(scene.cameras.size)
    if path in KINDS:
        photos = scene.cameras
        c2w = path_of(path, photos, seen_depth(scene), max(frames, 2))
        # all of the shorter side is seen
        factor = CropResize(photos.size, size).scale
        focal = factor * photos.intrinsics[0, :1, :2].expand(len(c2w), 2)
    else:
        c2w, focal = read_path(Path(path), size)
    height, width = size
    if fov is not None:
        focal = torch.full_like(focal, focal_length(fov, height))
    centres = focal.new_tensor([width / 2, height / 2]).expand_as(focal)
    cameras = Cameras(c2w, torch.cat([focal, centres], -1), size)
    return (cameras if path in KINDS else in_world(scene.world, cameras))[None]


def _film_size(photos: Size) -> Size:
    """Return even (H, W) of a video of `photos` (H, W); the shorter side is at least _HEIGHT."""
    factor = max(_HEIGHT / min(photos), 1.0)
    height, width = (round(side * factor / 2) * 2 for side in photos)
    return height, width


@torch.no_grad()
def seen_depth(scene: FilmScene) -> float:
    """Return the median rendered depth in the first, the middle and the last camera.

    The result is 1 if these cameras show no Gaussians.
    """
    # three views say enough, and each is rendered whole
    count = scene.cameras.shape[1]
    rendered = scene.renderer(scene.gaussians, scene.cameras[:, [0, count // 2, count - 1]])
    # a median of nothing is NaN
    return float(rendered.depth[rendered.alpha > 0.5].median().nan_to_num(1.0))


def open_film_scene(source: Path, photos: str | None, name: str | None) -> FilmScene:
    """Open the Gaussians of a scene and the cameras of its photos.

    source: folder of `qgs reconstruct` or `qgs scene`, or a PLY file. photos: photos whose cameras
    are read; not used for a folder of `qgs reconstruct`. name: scene of `photos` if it has several.
    Raises FileNotFoundError for any other `source`, ValueError if `photos` is needed but None.
    """
    if has_record(source):
        record = read_record(source)
        cameras = record.cameras[:, : len(record.inputs)]
        return FilmScene(record.gaussians, cameras, AutoRenderer(record.renderer), record.world)
    file = source / "scene.ply" if source.is_dir() else source
    if not file.is_file():
        raise FileNotFoundError(
            f"{source} is not a PLY file and has neither {GAUSSIANS} with cameras.json nor "
            "scene.ply: give a folder that `qgs reconstruct` or `qgs scene` wrote, or a PLY file"
        )
    if photos is None:
        raise ValueError(f"{file} holds no cameras: name the photos, `qgs video {source} PHOTOS`")
    gaussians = load_ply(file)
    cameras = photo_scene(photos, None, name).cameras.to(torch.float64)
    cameras = cameras.replace(c2w=scaled(cameras.c2w, factor_of(file)))
    # near of renderers is made for worlds in which what is seen is about 1 away
    w2c = torch.linalg.inv(cameras.c2w[0])
    depths = gaussians.means[0].double() @ w2c[2, :3] + w2c[2, 3]
    # a median of nothing is NaN
    depth = depths[depths > 0].median().nan_to_num(1.0)
    world = (cameras.c2w[0], 1 / depth)
    inside = in_world(world, cameras)[None]
    return FilmScene(in_own_world(world, gaussians), inside, VIEWER, world)
