"""A short run of tools/fuzz_recipes.py; see there."""

import random
from pathlib import Path

import pytest
from fuzz_recipes import Case, base, judged, made, main, names, refusal_fault

from qgs.composer import RecipeError, RecipeProblem


def test_cases_are_the_same_each_time() -> None:
    for number in range(20):
        first, second = made(3, number), made(3, number)
        assert first.overrides == second.overrides
        if not first.mapping:
            assert first.written() == second.written()
    assert made(3, 1).written() != made(4, 1).written()


def test_a_refusal_is_judged(tmp_path: Path) -> None:
    """A message that is too long, or blames a component for a failure inside, is a fault."""
    name = names()[0]
    case = Case(name, {**base(name)[0], "seed": -1}, random.Random(0))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    assert judged(case, tmp_path) == ""
    long = RecipeError([RecipeProblem("a", "x" * 200_000, "", "f", 1)])
    failed = RecipeError([RecipeProblem("a", "x", "", "f", 1, KeyError("inside"))])
    assert "characters" in refusal_fault(long)
    assert "inside" in refusal_fault(failed)


@pytest.mark.slow
def test_mutated_recipes_pass_or_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["fuzz_recipes", "--cases", "150", "--seed", "17"])
    assert main() == 0, capsys.readouterr().out
