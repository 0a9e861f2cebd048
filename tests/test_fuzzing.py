"""Runs of `tools/fuzz.py data` and `recipes`; see there."""

from importlib import import_module

import pytest
from fuzzing import cases


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["data", "recipes"])
def test_damaged_input_is_read_or_refused(kind, monkeypatch, capsys, tmp_path):
    module = import_module(f"fuzzing.{kind}")
    monkeypatch.chdir(tmp_path)
    assert cases.fuzz(module, tmp_path, seed=0, count=200) == 0, capsys.readouterr().out
