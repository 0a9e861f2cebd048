import sys

import pytest

from qgs.data.paths import is_local, opened_path, stays_inside


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
