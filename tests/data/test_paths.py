import threading
import zipfile

from photo_formats import opened, scene, synthetic, uploaded, write_nerfstudio
from tables import assert_equal, must_refuse
from upath import UPath

from qgs.contracts import ViewsConfig
from qgs.data.stream import SampleStream
from qgs.paths import is_local, open_file, opened_path, read_file, read_json


def test_local_paths_are_told_from_urls(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert is_local(opened_path("~/a"))
    assert str(opened_path("~/a")) == str(tmp_path / "a")
    assert str(opened_path(f"file://{tmp_path}/a")) == str(tmp_path / "a")
    assert not is_local(opened_path("memory://a"))
    must_refuse("nosuch://a", opened_path, "nosuch://a")


def before_files_open(path, monkeypatch, act):
    """Have the file system of `path` call `act` whenever it opens a file."""
    system = type(path.fs)
    whole = system._open

    def acting(self, *given, **options):
        act()
        return whole(self, *given, **options)

    monkeypatch.setattr(system, "_open", acting)


def test_photos_of_a_store_are_read_several_at_a_time(tmp_path, monkeypatch):
    folder = tmp_path / "scene"
    url = f"memory://{tmp_path.name}"
    write_nerfstudio(folder, synthetic(tmp_path / "photos"))
    uploaded(folder, UPath(url))
    expected = scene(folder).images([0, 2, 1])
    photos = scene(url)
    views = ViewsConfig(inputs=2, targets=1, gap=(1, 3))
    assert SampleStream(opened(url, holdout=0), views, 0).batch([0]).scenes
    together = threading.Barrier(3)
    before_files_open(UPath(url), monkeypatch, lambda: together.wait(30))
    assert_equal(photos.images([0, 2, 1]), expected)


def zeros_in(path, count):
    """A member of a new archive."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("inside", bytes(count))
    return UPath(f"zip:///::{path}") / "inside"


def test_files_that_are_read_whole_have_a_limit(tmp_path):
    with (tmp_path / "huge.json").open("wb") as file:
        file.truncate(2 * 10**9)
    huge = UPath(tmp_path / "huge.json")
    must_refuse(r"huge\.json is larger than 50\.0 MB", read_json, huge, "", kind=OSError)
    member = zeros_in(tmp_path / "a.zip", 10**6)
    assert len(open_file(member).read()) == 10**6
    must_refuse(r"inside.*a\.zip is larger than 1\.0 kB", read_file, member, 1000, kind=OSError)


def test_an_archive_that_another_thread_replaces_stays_open_while_it_is_read(tmp_path, monkeypatch):
    member = zeros_in(tmp_path / "a.zip", 10**5)
    before_files_open(member, monkeypatch, lambda: delattr(member, "_fs_cached"))
    assert len(read_file(member)) == 10**5
