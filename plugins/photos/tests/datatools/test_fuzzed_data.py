"""A run of tools/fuzz_data.py; see there."""

import pytest
from fuzz_data import prepared
from fuzzing import fuzz


@pytest.mark.slow
def test_damaged_data_sets_are_read_or_refused(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["fuzz_data", "--count", "200"])
    assert fuzz("", prepared) == 0, capsys.readouterr().out
