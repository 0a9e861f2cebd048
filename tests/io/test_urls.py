import sys

import pytest
from upath import UPath

from qgs.data.paths import is_local, opened_path, stays_inside
from qgs.io.files import opened_replacing, write_bytes


@pytest.fixture(params=["{}", "file://{}", "memory://urls{}"])
def folder(request, tmp_path) -> UPath:
    return opened_path(request.param.format(tmp_path / "folder"))


def write_half(file: UPath) -> None:
    with opened_replacing(file) as opened:
        opened.write(b"half")
        raise KeyError


def test_files_appear_whole_or_not_at_all(folder):
    file = folder / "a.bin"
    write_bytes(file, b"first")
    with pytest.raises(KeyError):
        write_half(file)
    assert file.read_bytes() == b"first"
    write_bytes(file, b"second")
    assert file.read_bytes() == b"second"
    assert [item.name for item in folder.iterdir()] == ["a.bin"]


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
