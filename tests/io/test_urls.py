import logging
import sys
import threading
import zipfile
import zlib
from functools import partialmethod
from pathlib import Path

import pytest
import torch
from photo_formats import opened, scene, synthetic, write_nerfstudio
from upath import UPath

from qgs.contracts import ViewsConfig
from qgs.data.chunk_files import load_chunk
from qgs.data.paths import (
    PAUSES,
    Archive,
    StoreError,
    is_local,
    opened_path,
    read_file,
    read_json,
    stays_inside,
)
from qgs.data.photos.reader import existing
from qgs.data.scenes import warn_once
from qgs.data.stream import SampleError, SampleStream, _prepare_worker


def test_local_paths_are_told_from_urls(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert is_local(opened_path("~/a"))
    assert str(opened_path("~/a")) == str(tmp_path / "a")
    assert str(opened_path(f"file://{tmp_path}/a")) == str(tmp_path / "a")
    assert not is_local(opened_path("memory://a"))
    with pytest.raises(ValueError, match="nosuch://a cannot be opened as a path or URL"):
        opened_path("nosuch://a")


@pytest.mark.parametrize(
    ("url", "module", "command"),
    [
        ("http://host/a", "aiohttp", "pip install requests aiohttp"),
        ("s3://bucket/a", "s3fs", "pip install s3fs"),
    ],
)
def test_the_package_of_a_file_system_is_told(monkeypatch, url, module, command):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "fsspec.implementations.http", raising=False)
    with pytest.raises(ValueError, match=f"{url} cannot be opened: .*: {command}$"):
        opened_path(url)


@pytest.mark.parametrize("name", ["a", "a/b.torch", "a..b", ".hidden", "a\\b"])
def test_names_that_stay_inside(name):
    assert stays_inside(name)


@pytest.mark.parametrize("name", ["..", "a/../b", "/a", "\\a", "a\\..\\..\\b", "c:/a", "", "C:a"])
def test_names_that_lead_outside(name):
    assert not stays_inside(name)


MemoryFileSystem = type(UPath("memory://").fs)


class Store:
    """A store in memory that fails so many times before a file can be read."""

    left = 0


@pytest.fixture
def flaky(tmp_path, monkeypatch) -> str:
    """The URL of a scene in it."""
    whole = {name: getattr(MemoryFileSystem, name) for name in ("_open", "cat_file")}

    def failing(store, name, path, *mode, **options):
        if Store.left and mode[:1] != ("wb",):
            Store.left -= 1
            raise ConnectionResetError("the peer hung up")
        return whole[name](store, path, *mode, **options)

    monkeypatch.setattr(Store, "left", 0)
    folder, url = tmp_path / "scene", f"memory://{tmp_path.name}"
    write_nerfstudio(folder, synthetic(tmp_path / "photos"))
    for file in filter(Path.is_file, folder.rglob("*")):
        place = UPath(url) / file.relative_to(folder).as_posix()
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(file.read_bytes())
    for name in whole:
        monkeypatch.setattr(MemoryFileSystem, name, partialmethod(failing, name))
    return url


@pytest.fixture
def pauses(monkeypatch) -> list[float]:
    waited: list[float] = []
    monkeypatch.setattr("qgs.data.paths.time.sleep", waited.append)
    return waited


def test_a_store_that_fails_is_asked_again(flaky, tmp_path, pauses, caplog):
    expected = scene(tmp_path / "scene").images([2])
    Store.left = 2
    photos = scene(flaky)  # its listing
    assert pauses == [1.0, 4.0]
    Store.left = 1
    assert torch.equal(photos.images([2]), expected)
    assert pauses == [1.0, 4.0, 1.0]
    assert "view_002.png: the peer hung up; the store is asked again in 1 s" in caplog.text
    source, views = opened(flaky, holdout=0), ViewsConfig(inputs=2, targets=1, gap=(1, 3))
    Store.left = 2
    assert SampleStream(source, views, 0).batch([0]).scenes
    with pytest.raises(FileNotFoundError):
        read_file(UPath(f"{flaky}/nothing"))
    assert len(pauses) == 5


def test_remote_photos_are_asked_for_at_once(flaky, tmp_path, monkeypatch):
    expected, together = scene(tmp_path / "scene").images([0, 2, 1]), threading.Barrier(3)
    photos, whole = scene(flaky), MemoryFileSystem.cat_file

    def waiting(store, path, *given, **options):
        together.wait(30)
        return whole(store, path, *given, **options)

    monkeypatch.setattr(MemoryFileSystem, "cat_file", waiting)
    assert torch.equal(photos.images([0, 2, 1]), expected)


def test_a_store_that_fails_for_good_is_one_error_with_the_url(flaky, pauses):
    photos, source = scene(flaky), opened(flaky, holdout=0)
    Store.left = 99
    for action in (
        lambda: photos.images([2]),
        lambda: scene(flaky),
        lambda: read_file(UPath(flaky) / "transforms.json"),
    ):
        with pytest.raises(
            StoreError, match=r"failed 5 times in a row, at last with: the peer"
        ) as e:
            action()
        assert str(e.value).startswith(flaky)
    assert pauses == [*PAUSES] * 3
    views = ViewsConfig(inputs=2, targets=1, gap=(1, 3))
    for skips in (False, True):  # a fault of the store is none of the sample
        with pytest.raises(SampleError, match=f"{flaky}/images/view_.*failed 5 times in a row"):
            SampleStream(source, views, 0, skips).batch([0])


def test_a_listing_that_fails_hides_no_photos(flaky, pauses, monkeypatch):
    names = [UPath(flaky) / "images" / name for name in ("view_002.png", "nothing.png")]
    whole = MemoryFileSystem.ls

    def failing(store, path, detail=True, **options):
        if Store.left:
            Store.left -= 1
            raise TimeoutError("no answer")
        return whole(store, path, detail, **options)

    monkeypatch.setattr(MemoryFileSystem, "ls", failing)
    Store.left = 2
    assert existing(names) == set(names[:1])
    assert pauses == [1.0, 4.0]
    assert existing([UPath(flaky) / "no" / "folder.png"]) == set()
    Store.left = 5
    with pytest.raises(StoreError, match="no answer"):
        existing(names)


def test_what_is_damaged_is_not_blamed_on_the_store(flaky, pauses):
    file = UPath(flaky) / "a.zip"
    file.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="is no zip archive"):
        Archive(file)
    with pytest.raises(OSError, match=r"a\.zip is larger than 5 bytes"):
        read_file(file, 5)
    assert pauses == []


def test_a_remote_archive_and_a_remote_chunk_are_asked_again(flaky, tmp_path, pauses):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as opened_zip:
        opened_zip.writestr("a.txt", "x" * 100)
    archive, chunk = UPath(flaky) / "a.zip", UPath(flaky) / "0.torch"
    archive.write_bytes((tmp_path / "a.zip").read_bytes())
    torch.save([], tmp_path / "0.torch")
    chunk.write_bytes((tmp_path / "0.torch").read_bytes())
    Store.left = 2
    assert Archive(archive).read("a.txt") == b"x" * 100
    Store.left = 2
    assert load_chunk(chunk) == []
    Store.left = 5
    with pytest.raises(StoreError, match=f"^{flaky}/0.torch"):
        load_chunk(chunk)
    assert pauses == [1.0, 4.0] * 2 + [*PAUSES]


CONTENT = bytes(range(256)) * 4


@pytest.fixture
def answers(tmp_path, monkeypatch) -> tuple[UPath, list[int]]:
    """A file in a store, and how many bytes each of its next answers has at most."""
    file, most = UPath(f"memory://{tmp_path.name}/file"), list[int]()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(CONTENT)
    whole = MemoryFileSystem.cat_file

    def cut(store, path, start=None, end=None, **options):
        content = whole(store, path, start, end, **options)
        return content[: most.pop(0)] if most else content

    monkeypatch.setattr(MemoryFileSystem, "cat_file", cut)
    return file, most


def test_answers_that_stop_early_are_completed(answers, pauses, caplog):
    file, most = answers
    for cuts in ([1000], [1, 2, 3], [0, 5], [700, 0, 0, 20]):
        most[:] = cuts
        assert read_file(file) == CONTENT
    assert pauses == [1.0, 4.0]
    assert "0 bytes came of those from 700 to 1,024" in caplog.text
    most[:] = [700] + [0] * 9
    with pytest.raises(StoreError, match="failed 5 times in a row, at last with: 0 bytes"):
        read_file(file)


@pytest.mark.parametrize("part", [100, 512, 1024, 5000])
def test_large_files_come_in_parts(answers, monkeypatch, part):
    monkeypatch.setattr("qgs.data.paths.PART", part)
    assert read_file(answers[0]) == CONTENT
    with pytest.raises(OSError, match="is larger than 600 bytes"):
        read_file(answers[0], 600)


@pytest.mark.parametrize("part", [100, 1024, 5000])
def test_a_store_that_does_not_tell_sizes(answers, monkeypatch, part):
    monkeypatch.setattr("qgs.data.paths.PART", part)
    monkeypatch.setattr(MemoryFileSystem, "info", lambda *_, **__: {"size": None})
    assert read_file(answers[0]) == CONTENT


def test_a_read_that_never_ends_is_asked_again(answers, monkeypatch, pauses, caplog):
    whole, ended, asked = MemoryFileSystem.cat_file, threading.Event(), []

    def hanging(store, path, *given, **options):
        asked.append(path)
        if len(asked) == 1:
            ended.wait(60)
        return whole(store, path, *given, **options)

    monkeypatch.setattr(MemoryFileSystem, "cat_file", hanging)
    monkeypatch.setattr("qgs.data.paths.PATIENCE", 0.05)
    assert read_file(answers[0]) == CONTENT
    assert pauses == [1.0]
    assert "no answer in 0.05 s; the store is asked again in 1 s" in caplog.text
    ended.set()


def test_workers_tell_that_a_store_is_asked_again(answers, pauses, caplog, monkeypatch):
    monkeypatch.setattr("qgs.data.stream.atexit.register", lambda *_: None)
    monkeypatch.setattr("qgs.data.stream.signal.signal", lambda *_: None)
    logger = logging.getLogger("qgs.data.scenes")
    level = logger.level
    try:
        _prepare_worker(0)
        warn_once("opened")
        answers[1][:] = [0, 0]
        read_file(answers[0])
    finally:
        logger.setLevel(level)
    assert [record.name for record in caplog.records] == ["qgs.data.paths"]


def test_a_file_that_is_read_whole_has_a_limit(tmp_path):
    with (tmp_path / "huge.json").open("wb") as file:
        file.truncate(2 * 10**9)
    with pytest.raises(ValueError, match=r"huge.json .* \(it is larger than 50 MB"):
        read_json(UPath(tmp_path / "huge.json"), "")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(member := zipfile.ZipInfo("bomb"), zlib.compress(b"")[2:-4])
        member.compress_type, member.file_size = zipfile.ZIP_DEFLATED, 4 * 10**9
    with pytest.raises(OSError, match="bomb is larger than 500 MB"):
        Archive(UPath(tmp_path / "a.zip")).read("bomb")
