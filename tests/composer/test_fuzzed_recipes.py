"""A short run of tools/fuzz_recipes.py; see there."""

import os
import random
import time
from pathlib import Path

import pytest
from fuzz_recipes import Case, base, judged, made, names, prepared, refuse_faulty
from fuzzing import FaultError, ended, fuzz, refused

from qgs.composer import RecipeError, RecipeProblem


def test_cases_are_the_same_each_time() -> None:
    for number in range(20):
        first, second = made(random.Random(number)), made(random.Random(number))
        assert first.overrides == second.overrides
        if not first.mapping:
            assert first.bytes() == second.bytes()


def test_a_refusal_is_judged(tmp_path: Path) -> None:
    """A message that is too long, or blames a component for a failure inside, is a fault."""
    name = names()[0]
    case = Case(name, {**base(name)[0], "seed": -1}, random.Random(0))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    assert judged(case, tmp_path) == "refused RecipeError"
    with pytest.raises(FaultError, match="characters"):
        refused(RecipeError([RecipeProblem("a", "x" * 200_000, "", "f", 1)]))
    with pytest.raises(FaultError, match="no file is named"):
        refused(ValueError("runs/a is bad"), "runs/a/state.safetensors")
    with pytest.raises(FaultError, match="inside"):
        refuse_faulty(RecipeError([RecipeProblem("a", "x", "", "f", 1, KeyError("inside"))]))


def test_ends_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ended(lambda: "success") == ("success", "")
    assert "ZeroDivisionError" in ended(lambda: str(1 / 0))[1]
    assert "ended with 3" in ended(lambda: os._exit(3))[1]
    monkeypatch.setattr("fuzzing.BYTES", 10**6)
    assert "MB, then: done" in ended(lambda: "done")[1]
    monkeypatch.setattr("fuzzing.SECONDS", 0.1)
    assert "hangs" in ended(lambda: time.sleep(60) or "")[1]


@pytest.mark.slow
def test_mutated_recipes_pass_or_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["fuzz_recipes", "--count", "150", "--seed", "17"])
    assert fuzz("", prepared) == 0, capsys.readouterr().out
