"""Data that nobody meant: one error with the file, in reading as in `qgs data check`."""

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import photo_formats
import pytest
import torch
from attack import attack
from fuzz_data import prepared
from photo_formats import encoded, opened, synthetic, write_colmap, write_llff, write_nerfstudio
from qgs_datatools.check import Options, check
from upath import UPath

from qgs.data import ChunksSource
from qgs.data.paths import ArchivePath, open_file

HUGE = 10**400


def told(folder) -> list[str]:
    """Errors of a check."""
    report = check(UPath(folder), Options(geometry=0, threads=1))
    return [str(finding) for finding in report.findings if finding.severity == "error"]


def everything(folder, source=photo_formats.PhotosSource) -> None:
    for scene in opened(folder, source=source).scenes("train"):
        frames = range(len(scene.cameras.c2w))
        scene.images(frames), scene.masks(frames), scene.depths(frames)


def changed(change):
    """A nerfstudio folder with another transforms.json. change: of its content or its text."""

    def write(folder: Path) -> str:
        write_nerfstudio(folder, synthetic(folder / "photos"))
        file = folder / "transforms.json"
        data = json.loads(file.read_text())
        text = change(data)
        file.write_text(text if isinstance(text, str) else json.dumps(data))
        return "transforms.json"

    return write


def pose(data) -> None:
    data["frames"][1]["transform_matrix"][0][3] = HUGE


def as_pipe(name: str):
    def write(folder: Path) -> str:
        changed(lambda data: data["frames"][1].update(mask_path="m.png", depth_file_path="d.npy"))(
            folder
        )
        for other in {"m.png", "d.npy"} - {name}:
            data = encoded(np.full((30, 40), 255, np.uint8))
            (folder / other).write_bytes(data if other == "m.png" else b"")
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)
        return Path(name).name

    return write


def colmap_of(word: str, value: str, file: str = "cameras.txt"):
    def write(folder: Path) -> str:
        write_colmap(folder, synthetic(folder / "photos"), "text")
        place = folder / "sparse" / "0" / file
        place.write_text(place.read_text().replace(word, value))
        return "sparse/0"

    return write


def llff(folder: Path) -> str:
    write_llff(folder, synthetic(folder / "photos"))
    header = {"descr": "<f8", "fortran_order": False, "shape": (50 * 10**9, 17)}
    with (folder / "poses_bounds.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    return "poses_bounds.npy"


def with_hole(file: Path, start: bytes, size: int = 3_000_000_000) -> None:
    """A file that takes no space beyond `start`."""
    file.write_bytes(start)
    os.truncate(file, size)


def json_with_hole(folder: Path) -> str:
    name = changed(lambda data: None)(folder)
    with_hole(folder / name, (folder / name).read_bytes())
    return name


def colmap_with_hole(suffix: str, name: str):
    def write(folder: Path) -> str:
        kind = "binary" if suffix == "bin" else "text"
        write_colmap(folder, synthetic(folder / "photos"), kind)
        start = (2**40).to_bytes(8, "little") if suffix == "bin" else b""
        with_hole(folder / "sparse" / "0" / f"{name}.{suffix}", start)
        return "sparse/0"

    return write


def depth_with_hole(folder: Path) -> str:
    changed(lambda data: [f.update(depth_file_path="d.npy") for f in data["frames"]] and None)(
        folder
    )
    header = {"descr": "|u1", "fortran_order": False, "shape": (60_000, 60_000)}
    with (folder / "d.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    os.truncate(folder / "d.npy", (folder / "d.npy").stat().st_size + 60_000**2)
    return "d.npy"


def endless(folder: Path) -> str:
    write_colmap(folder, synthetic(folder / "photos"), "text")
    with (folder / "sparse" / "0" / "images.txt").open("wb") as file:
        file.truncate(10**12)
    return "images.txt has a line of 33,554,432 characters or more"


FOLDERS = {
    "a listing with a hole": json_with_hole,
    "COLMAP images with a hole": colmap_with_hole("bin", "images"),
    "COLMAP cameras with a hole": colmap_with_hole("bin", "cameras"),
    "COLMAP text with a hole": colmap_with_hole("txt", "images"),
    "a depth map of 3.6 gigapixels": depth_with_hole,
    "images.txt of 1 TB": endless,
    "a COLMAP word of 100,000 letters": colmap_of(" 50.0 ", f" {'x' * 100_000} "),
    "a pose of 400 digits": changed(pose),
    "a focal length of 400 digits": changed(lambda data: data.update(fl_x=HUGE)),
    "a principal point of 400 digits": changed(lambda data: data.update(cx=-HUGE)),
    "a width of 400 digits": changed(lambda data: data.update(w=HUGE)),
    "a width of 1e300": changed(lambda data: data.update(w=1e300)),
    "a number of 5000 digits": changed(lambda data: '{"frames": [' + "9" * 5000 + "]}"),
    "100,000 brackets": changed(lambda data: "[" * 100_000 + "]" * 100_000),
    "one photo": changed(lambda data: data.update(frames=data["frames"][:1])),
    "an image that is a pipe": as_pipe("images/view_001.png"),
    "a mask that is a pipe": as_pipe("m.png"),
    "a depth map that is a pipe": as_pipe("d.npy"),
    "a COLMAP size of 400 digits": colmap_of(" 40 ", f" {HUGE} "),
    "a COLMAP focal length of 400 digits": colmap_of(" 50.0 ", f" {HUGE} "),
    "poses of 6 TiB": llff,
}


def test_a_photo_with_a_hole_is_not_read_as_a_whole(tmp_path):
    changed(lambda data: None)(tmp_path)
    image = next((tmp_path / "images").iterdir())
    with_hole(image, image.read_bytes())
    assert any("larger than 500 MB" in line and image.name in line for line in told(tmp_path))


def test_a_member_of_an_archive_that_is_too_large_is_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("large", bytes(1001))
    with pytest.raises(OSError, match="large is larger than 1 kB"):
        open_file(ArchivePath(UPath(tmp_path / "a.zip"), "large"), 1000)


@pytest.mark.parametrize("kind", FOLDERS)
def test_a_folder_of_photos(tmp_path, kind):
    folder = tmp_path / "scene"
    file = FOLDERS[kind](folder)
    if kind.endswith("map that is a pipe"):  # maps are read where all frames have one
        (scene,) = opened(folder).scenes("train")
        with pytest.raises(ValueError, match=file):
            scene.depths([1])
    else:
        with pytest.raises((ValueError, FileNotFoundError), match=file):
            everything(folder)
    lines = told(folder)
    assert lines
    assert not any("Error" in line for line in lines), lines


def record(count: int = 4, **changes) -> dict:
    cameras = torch.tensor([[0.8, 0.8, 0.5, 0.5, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.0]])
    cameras = cameras.repeat(count, 1)
    cameras[:, 9] = torch.arange(count)
    rng = np.random.default_rng(0)
    images = [encoded(rng.integers(0, 256, (16, 16, 3), np.uint8)) for _ in range(count)]
    data = [torch.frombuffer(bytearray(image), dtype=torch.uint8) for image in images]
    return {"key": "s0", "cameras": cameras, "images": data, **changes}


def rows(change) -> dict:
    return record(cameras=change(record()["cameras"]))


WRONG_MASK = torch.frombuffer(
    bytearray(encoded(np.full((16, 30), 255, np.uint8))), dtype=torch.uint8
)
RECORDS = {
    "sparse cameras": (rows(torch.Tensor.to_sparse), "a sparse, quantised or expanded tensor"),
    "cameras of 1 TB": (
        record(images=[torch.zeros(1).byte().expand(10**12)] * 4),
        "'images' must be a list of one-dimensional uint8 tensors",
    ),
    "cameras that are objects": (record(cameras={"a": 1}), "a mapping with the keys 'a'"),
    "images that are objects": (record(images=[{}] * 4), "got a list of a dict"),
    "sizes of NaN": (record(sizes=torch.full((4, 2), torch.nan)), "'sizes' must be whole pixels"),
    "sizes of 0": (record(sizes=torch.zeros(4, 2).long()), "'sizes' must be whole pixels"),
    "held_out of a number": (record(held_out=7), "'held_out' must list frames from 0 to 3, got 7"),
    "held_out that is nowhere": (
        record(held_out=torch.zeros(2).to("meta")),
        "got a sparse, quantised or expanded tensor",
    ),
    "a list in itself": (record(names=[[]] * 3), "3 names for 4 images"),
    "a mask of another shape": (record(masks=[WRONG_MASK] * 4), "another aspect ratio"),
    "a mask that is none": (record(masks=[torch.zeros(9).byte()] * 4), "is unusable"),
}


def saved(folder: Path, *records) -> Path:
    (folder / "train").mkdir(parents=True)
    torch.save(list(records), folder / "train" / "a.torch")
    (folder / "train" / "index.json").write_text('{"s0": "a.torch"}')
    return folder


@pytest.mark.parametrize("kind", RECORDS)
def test_a_record_of_a_chunk(tmp_path, kind):
    given, message = RECORDS[kind]
    folder = saved(tmp_path, given)
    with pytest.raises(ValueError, match=rf"a\.torch: scene 's0'.*{message}"):
        everything(folder, ChunksSource)
    lines = told(folder)
    assert lines
    assert not any("Error" in line for line in lines), lines


class Payload:
    def __reduce__(self):
        return os.mkdir, ("/nowhere/at/all",)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_a_pickle_in_a_chunk_is_not_called_cut_off(tmp_path, protocol):
    folder = saved(tmp_path)
    torch.save([Payload()], folder / "train" / "a.torch", pickle_protocol=protocol)
    with pytest.raises(ValueError, match=r"a\.torch .*whose reading could run code"):
        everything(folder, ChunksSource)
    assert "whose reading could run code" in told(folder)[0]


def test_a_chunk_that_is_a_pipe(tmp_path):
    folder = saved(tmp_path)
    (folder / "train" / "a.torch").unlink()
    os.mkfifo(folder / "train" / "a.torch")
    with pytest.raises(ValueError, match=r"a\.torch .*no regular file"):
        everything(folder, ChunksSource)
    assert "no regular file" in told(folder)[0]


def test_a_chunk_with_a_scene_of_one_photo(tmp_path):
    lines = told(saved(tmp_path, record(1)))
    assert any("1 photos are there, and a scene needs 2" in line for line in lines)


def test_keys_that_no_terminal_prints(tmp_path):
    folder = saved(tmp_path, record(key="\x1b[2J" + "k" * 10_000))
    with pytest.raises(ValueError, match="does not hold the scene 's0'") as caught:
        everything(folder, ChunksSource)
    assert "holds '\\x1b[2Jkkk" in str(caught.value)
    assert len(str(caught.value)) < 2000


INDICES = ["[" * 100_000, '{"s0": ' + "9" * 5000 + "}", json.dumps({"s0": "x" * 100_000})]


@pytest.mark.parametrize("content", INDICES, ids=["deep", "number", "name"])
def test_an_index_of_chunks(tmp_path, content):
    folder = saved(tmp_path, record())
    (folder / "train" / "index.json").write_text(content)
    with pytest.raises(ValueError, match=r"index\.json") as caught:
        opened(folder, source=ChunksSource)
    assert len(str(caught.value)) < 2000
    assert told(folder)


@pytest.mark.slow
def test_attacks_end_in_one_error_of_ours(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["fuzz_data", "--count", "40"])
    assert attack("", prepared) == 0, capsys.readouterr().out
