"""Files and folders that appear whole or not at all."""

import errno
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError

from qgs.io.files import (
    DiskFullError,
    is_leftover,
    replacing,
    replacing_entries,
    write_text,
)
from qgs.io.tensors import write_tensors


def test_entries_are_replaced_whole_and_the_rest_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "views").mkdir(parents=True)
    (out / "views" / "old.png").touch()
    (out / "notes.txt").write_text("mine")
    with replacing_entries(out, "views") as fresh:
        (fresh / "views").mkdir()
        (fresh / "views" / "new.png").touch()
    assert [path.name for path in (out / "views").iterdir()] == ["new.png"]
    assert (out / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_entries_of_no_earlier_result_stay(tmp_path: Path) -> None:
    (tmp_path / "out" / "depth").mkdir(parents=True)
    (tmp_path / "out" / "depth" / "sensor.png").write_text("mine")

    def write() -> None:
        with replacing_entries(tmp_path / "out", "scene.ply") as fresh:
            (fresh / "scene.ply").touch()
            (fresh / "depth").mkdir()

    with pytest.raises(FileExistsError, match="depth"):
        write()
    assert (tmp_path / "out" / "depth" / "sensor.png").read_text() == "mine"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["depth"]


def test_entries_come_back_where_moving_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in ("a", "b"):
        (out / name).write_text("old")
    rename = Path.rename

    def interrupted(self: Path, target: Path) -> Path:
        if self.parent.name == "fresh" and self.name == "b":
            raise KeyboardInterrupt
        return rename(self, target)

    def write() -> None:
        with replacing_entries(out, "a") as fresh:
            for name in ("a", "b"):
                (fresh / name).write_text("new")
            monkeypatch.setattr(Path, "rename", interrupted)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert {path.name: path.read_text() for path in out.iterdir()} == {"a": "old", "b": "old"}


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("words", "number", "full"),
    [
        ("I/O error: No space left on device (os error 28)", errno.ENOSPC, True),
        ("I/O error: Disk quota exceeded (os error 122)", errno.EDQUOT, True),
        ("I/O error: File too large (os error 27)", errno.EFBIG, False),
        ("I/O error: Permission denied (os error 13)", errno.EACCES, False),
    ],
)
def test_a_disk_is_called_full_only_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, number: int, full: bool
) -> None:
    def fail(*_: object) -> None:
        raise SafetensorError(words)

    monkeypatch.setattr("qgs.io.tensors.save_file", fail)
    with pytest.raises(OSError, match=r"a\.safetensors") as caught:
        write_tensors(tmp_path / "a.safetensors", {"a": torch.ones(1)}, {})
    assert isinstance(caught.value, DiskFullError) == full
    assert full or caught.value.errno == number
    assert words in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_leftovers_of_killed_processes_are_told_from_what_users_made(tmp_path: Path) -> None:
    for name in (".state.safetensors.tmp", "notes.12.tmp", ".git", "state.safetensors"):
        (tmp_path / name).touch()
        assert not is_leftover(tmp_path / name)
    (tmp_path / ".tmpA9b0zZ").touch()
    assert is_leftover(tmp_path / ".tmpA9b0zZ")
    (tmp_path / ".folder.12.tmp").mkdir()
    assert not is_leftover(tmp_path / ".folder.12.tmp")
    with replacing(tmp_path / "state") as temporary:
        assert is_leftover(temporary)
