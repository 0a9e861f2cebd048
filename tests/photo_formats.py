"""One set of photos written in every format that `qgs/photos` reads, and read again, for tests.

The writers share no code with the readers: they follow the descriptions of the formats.
"""

import io
import pickle  # noqa: TID251  as multiprocessing does
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from tables import assert_equal, write_json
from walk import along_x

from qgs.data import PhotosSource


@dataclass(frozen=True)
class PhotoSet:
    """Photos in files, by name, and what took them: c2w (F, 4, 4) OpenCV, one pinhole."""

    files: tuple[Path, ...]
    c2w: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]


def noise(*shape, seed=0):
    """Bytes, such as images (N, H, W, 3)."""
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def write_photos(folder, images, name="{}.png"):
    """Save images (H, W, 3) under their numbers; their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / name.format(number))
    return folder


def photo_set(folder, images, c2w, intrinsics, name="{}.png"):
    """Photos that are written there."""
    write_photos(folder, images, name)
    files = tuple(folder / name.format(number) for number in range(len(images)))
    return PhotoSet(files, c2w, intrinsics, images[0].shape[:2])


def synthetic(folder, count=6, size=(30, 40), seed=0, suffix="png"):
    """Photos of noise at random poses."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (count, *size, 3), dtype=np.uint8)
    c2w = np.tile(np.eye(4), (count, 1, 1))
    c2w[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    c2w[:, :3, 3] = rng.normal(size=(count, 3)) * 5
    return photo_set(folder, images, c2w, (50.0, 52.0, 19.0, 16.0), f"view_{{:03d}}.{suffix}")


def opened(path, size=(30, 40), source=PhotosSource, **options):
    """The data at `path`, opened by a class of sources."""
    return source(source.Config(path=str(path), image_size=size, **options))


LENS = ("fl_x", "fl_y", "cx", "cy", "h", "w")


def listed_lens(*numbers):
    """What a listing says of a camera."""
    return dict(zip(LENS, numbers, strict=True))


def encoded(image, kind="PNG", **options):
    """The bytes of an image file. image: (H, W, 3 or 4) uint8."""
    file = io.BytesIO()
    image = image if isinstance(image, Image.Image) else Image.fromarray(image)
    image.save(file, kind, **options)
    return file.getvalue()


def turned(orientation):
    """EXIF data that turn or mirror a photo."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


def row_of_frames(count, step=1.0, **top):
    """The content of transforms.json for `images/0.png`, ...: cameras `step` apart along x."""
    frames = [
        {"file_path": f"images/{i}.png", "transform_matrix": pose}
        for i, pose in enumerate(along_x(step * np.arange(count)).tolist())
    ]
    return {**top, "frames": frames}


def write_row(folder, images, step=1.0, cameras=(), kind="PNG", **top):
    """Images and their `row_of_frames`. cameras: what the first frames have of their own.

    kind: of the files, whatever their names say.
    """
    content = row_of_frames(len(images), step, **top)
    for frame, own in zip(content["frames"], cameras, strict=False):
        frame.update(own)
    for number, image in enumerate(images):
        put(folder / f"images/{number}.png", encoded(image, kind))
    write_json(folder / "transforms.json", content)
    return folder


def scene(path, size=(30, 40), **options):
    """The first training scene of what is `opened`."""
    return opened(path, size, **options).scenes("train")[0]


def assert_travels(source):
    """Other processes read a source and its scenes as this one does, and get no open files."""
    scene = source.scenes("train")[0]
    before = scene.images([1])
    data = pickle.dumps((source, scene))
    assert len(data) < 3000
    source, scene = pickle.loads(data)  # noqa: S301
    for copy in (scene, source.scenes("train")[0]):
        assert_equal(copy.images([1]), before)


def centred(photos):
    """The same set, taken by a camera that every format can tell."""
    focal, (height, width) = photos.intrinsics[0], photos.size
    return replace(photos, intrinsics=(focal, focal, width / 2, height / 2))


def copied(photos, folder, names=None):
    """Copy the files into `folder`; the names that they have there."""
    names = names or [file.name for file in photos.files]
    for file, name in zip(photos.files, names, strict=True):
        put(folder / name, file.read_bytes())
    return names


def put(path, content):
    """Write a file of these bytes, and the folders that it lies in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def cut(path, part):
    """Only the first part of a file."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    return path


def uploaded(folder, place):
    """Copy the files in `folder` to a place of another file system."""
    place.fs.put(f"{folder}/", place.path, recursive=True)


def opengl(c2w):
    return (c2w * [1, -1, -1, 1]).tolist()


def write_nerfstudio(folder, photos, **top):
    names = copied(photos, folder / "images")
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl(pose)}
        for name, pose in zip(names, photos.c2w, strict=True)
    ]
    camera = listed_lens(*photos.intrinsics, *photos.size)
    content = {"camera_model": "OPENCV", **camera, **top, "frames": frames}
    write_json(folder / "transforms.json", content)
    return folder


def write_blender(folder, photos, train, val=0, times=()):
    """The first photos are for training, then `val` for validation, the rest for tests.

    Square pixels and a principal point in the middle are all that the format knows. times: of the
    photos, as D-NeRF writes them; ... leaves one out.
    """
    parts = {"train": [], "val": [], "test": []}
    for i, file in enumerate(photos.files):
        part = "train" if i < train else "val" if i < train + val else "test"
        put(folder / part / f"{file.stem}.png", encoded(Image.open(file)))
        frame = {"file_path": f"./{part}/{file.stem}", "rotation": 0.01}
        if i < len(times) and times[i] is not ...:
            frame["time"] = times[i]
        parts[part].append({**frame, "transform_matrix": opengl(photos.c2w[i])})
    angle = 2 * np.arctan(photos.size[1] / 2 / photos.intrinsics[0])
    for part, frames in parts.items():
        if frames:
            content = {"camera_angle_x": angle, "frames": frames}
            write_json(folder / f"transforms_{part}.json", content)
    return folder


def write_llff(folder, photos):
    """Rows of (down, right, back, centre, (h, w, f)) as a (3, 5) matrix, then near and far."""
    copied(photos, folder / "images")
    right, down, ahead, centre = (photos.c2w[:, :3, i] for i in range(4))
    hwf = [[*photos.size, photos.intrinsics[0]]] * len(photos.files)
    matrix = np.stack([down, right, -ahead, centre, hwf], -1)
    bounds = [[0.5, 20.0]] * len(photos.files)
    np.save(folder / "poses_bounds.npy", np.hstack([matrix.reshape(-1, 15), bounds]))
    return folder


def write_colmap(folder, photos, kind, camera=None, model="sparse/0", images="images", names=None):
    """kind: text or binary, which pycolmap makes of it. camera: name and parameters of a model.

    Images are listed backwards, with two observations each.
    """
    names = copied(photos, folder / images, names)
    place = folder / model
    place.mkdir(parents=True, exist_ok=True)
    name, parameters = camera or ("PINHOLE", photos.intrinsics)
    height, width = photos.size
    numbers = " ".join(map(str, parameters))
    line = f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n7 {name} {width} {height} {numbers}\n"
    (place / "cameras.txt").write_text(line)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for number in range(len(names), 0, -1):
        pose = map(str, world_to_camera(photos.c2w[number - 1]))
        lines += [f"{number} {' '.join(pose)} 7 {names[number - 1]}"]
        lines += ["3.5 4.5 11 8.0 9.0 -1"]
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    (place / "points3D.txt").write_text("11 0 0 5 1 2 3 0.5 1 0 2 0\n")
    if kind == "binary":
        import pycolmap  # not where only text is written

        pycolmap.Reconstruction(str(place)).write_binary(str(place))
        for file in place.glob("*.txt"):
            file.unlink()
    return folder


def world_to_camera(c2w):
    """Quaternion w, x, y, z and translation of the inverse of a pose."""
    w2c = np.linalg.inv(c2w)
    return *Rotation.from_matrix(w2c[:3, :3]).as_quat(scalar_first=True), *w2c[:3, 3]


def numbered_photos(path, count=10, size=(64, 48), cameras=(), **top):
    """A row of photos whose red channel is 10 times their number."""
    given = listed_lens(100.0, 110.0, 31.0, 25.0, 48, 64)
    images = [Image.new("RGB", size, (10 * i, 50, 200)) for i in range(count)]
    return write_row(path, images, cameras=cameras, **given | top)


def noisy_photos(folder, count=7, step=0.1):
    """Nerfstudio photos of noise, 24 x 20, by cameras `step` apart that look the same way."""
    return write_row(folder, noise(count, 20, 24, 3), step, **listed_lens(20, 20, 12, 10, 20, 24))
