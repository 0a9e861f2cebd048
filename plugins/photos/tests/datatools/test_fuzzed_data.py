"""A run of `tools/fuzz.py data`; see there."""

import pytest
from fuzzing import cases, data


@pytest.mark.slow
def test_damaged_data_sets_are_read_or_refused(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert cases.fuzz(data, tmp_path, seed=0, count=200) == 0, capsys.readouterr().out
