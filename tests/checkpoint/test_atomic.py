"""Files and folders that appear whole or not at all."""

import errno
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from photo_formats import put
from safetensors import SafetensorError
from tables import contents, must_refuse, names_in

from qgs.checkpoint.tensors import write_tensors
from qgs.files import is_leftover, replacing, replacing_entries, write_text


def put_both(folder, content):
    for name in ("a/x", "b/x"):
        put(folder / name, content)


def test_entries_come_back_where_moving_fails(tmp_path, monkeypatch):
    put_both(tmp_path / "out", b"old")
    before = contents(tmp_path)
    rename = Path.rename

    def interrupted(self, target):
        if self.parent.name == "fresh" and self.name == "b":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt), replacing_entries(tmp_path / "out", "a") as fresh:
        put_both(fresh, b"new")
    assert contents(tmp_path) == before


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    before = contents(tmp_path)

    def fail():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert contents(tmp_path) == before


def test_a_disk_is_called_full_only_where_it_is(tmp_path, monkeypatch):
    for words, number in (
        ("I/O error: No space left on device (os error 28)", None),
        ("I/O error: Disk quota exceeded (os error 122)", None),
        ("I/O error: File too large (os error 27)", errno.EFBIG),
        ("I/O error: Permission denied (os error 13)", errno.EACCES),
    ):
        failure = SafetensorError(words)
        monkeypatch.setattr("qgs.checkpoint.tensors.save_file", Mock(side_effect=failure))
        given = tmp_path / "a.safetensors", {"a": torch.ones(1)}, {}
        error = must_refuse(r"a\.safetensors", write_tensors, *given, kind=OSError)
        full = number is None
        assert ("free space" in str(error)) == full
        assert full or error.errno == number
        assert words in str(error)
        assert not names_in(tmp_path)


def test_leftovers_of_killed_processes_are_told_from_what_users_made(tmp_path):
    for name in (".state.safetensors.tmp", "notes.12.tmp", ".git", "state.safetensors"):
        (tmp_path / name).touch()
        assert not is_leftover(tmp_path / name)
    (tmp_path / ".tmpA9b0zZ").touch()
    assert is_leftover(tmp_path / ".tmpA9b0zZ")
    (tmp_path / ".folder.12.tmp").mkdir()
    assert not is_leftover(tmp_path / ".folder.12.tmp")
    with replacing(tmp_path / "state") as temporary:
        assert is_leftover(temporary)
