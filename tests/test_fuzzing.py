"""Runs of `tools/fuzz.py data` and `recipes`; see there."""

from importlib import import_module

import pytest
from fuzzing import cases


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["data", "recipes"])
def test_damaged_input_is_read_or_refused(kind, capsys, here):
    module = import_module(f"fuzzing.{kind}")
    assert cases.fuzz(module, here, seed=0, count=200) == 0, capsys.readouterr().out
