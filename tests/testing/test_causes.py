"""What a component does wrong is told once, at the place of its own code."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from contract_mutants import broken
from contract_mutants.broken import CannotBeBuilt, CannotBeCalled, CannotBeCalledElsewhere
from contract_mutants.modules import AddsNoise
from pydantic import ConfigDict
from torch import Tensor

from qgs.components import MlpFeedForward
from qgs.testing import CHECKS, Case, CaseRun, checks_for, parametrize_with_checks, run_check

BROKEN = Path(broken.__file__)


def _line(text: str) -> int:
    return 1 + [text in line for line in BROKEN.read_text().splitlines()].index(True)


@pytest.mark.parametrize(
    ("component", "check", "culprit"),
    [
        (CannotBeBuilt, "builds", "raise RuntimeError"),
        (CannotBeCalled, "runs", "features @ torch.ones(3, 3)"),
        (CannotBeCalled, "sizes_vary", "features @ torch.ones(3, 3)"),
        (CannotBeCalledElsewhere, "saved_weights_run_elsewhere", "far from home"),
    ],
)
def test_an_error_is_told_with_its_place_in_the_component(component, check, culprit) -> None:
    outcome = run_check(CHECKS[check], Case(component.Config()))
    assert f" (raised under {BROKEN}:{_line(culprit)})\n" in outcome.message


class FailsAtFirst(MlpFeedForward):
    name = "fails_at_first"
    calls: ClassVar[list[int]] = []

    def forward(self, features: Tensor) -> Tensor:
        self.calls.append(1)
        if len(self.calls) == 1 or features.dtype == torch.float64:
            raise RuntimeError("not now")
        return super().forward(features)


PLACED = """
from qgs.components import MlpFeedForward
from placed_package.maths import root

class Placed(MlpFeedForward):
    name = "placed"

    def forward(self, features):
        return root(super().forward(features))
"""
MATHS = """
import torch

def root(x):
    return torch.linalg.cholesky(x.mT @ x - 1e6)
"""


def test_the_place_may_be_anywhere_in_the_package(tmp_path, monkeypatch) -> None:
    package = tmp_path / "placed_package"
    for folder in (package, package / "attention"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    (package / "attention" / "placed.py").write_text(PLACED)
    (package / "maths.py").write_text(MATHS)
    monkeypatch.syspath_prepend(tmp_path)
    placed = import_module("placed_package.attention.placed").Placed
    outcome = run_check(CHECKS["runs"], Case(placed.Config()))
    assert f"(raised under {package / 'maths.py'}:5)" in outcome.message


def test_a_class_of_no_file_has_a_place_too() -> None:
    scope = {"__name__": "of_no_file", "root": partial(torch.linalg.cholesky)}
    exec(PLACED.replace("from placed_package.maths import root", ""), scope)
    outcome = run_check(CHECKS["runs"], Case(scope["Placed"].Config()))
    assert "(raised under <string>:9)" in outcome.message


@pytest.mark.parametrize(
    ("component", "cause"), [(CannotBeBuilt, "builds"), (CannotBeCalled, "runs")]
)
def test_one_cause_is_one_failure(component, cause) -> None:
    run = CaseRun(Case(component.Config()))
    outcomes = [run.make(check) for check in checks_for(run.case, ["core"])]
    assert [o.check.name for o in outcomes if not o.ok] == [cause]
    skipped = [o for o in outcomes if o.verdict == "skipped"]
    assert len(skipped) > 20
    assert {(o.cause, o.message) for o in skipped} == {
        (cause, f"ends with an error as `{cause}` does: see that check")
    }
    assert {o.check.name for o in outcomes if o.verdict == "passed"} >= {
        "config_round_trip",
        "import_does_no_io",
    }


def test_what_is_seen_to_break_the_contract_is_told_besides() -> None:
    class CountsAndRaises(CannotBeCalled):
        name = "counts_and_raises"

        class Config(CannotBeCalled.Config):
            model_config = ConfigDict(frozen=False)

    run = CaseRun(Case(CountsAndRaises.Config()))
    outcomes = {check.name: run.make(check) for check in checks_for(run.case, ["core"])}
    assert {name for name, outcome in outcomes.items() if not outcome.ok} == {
        "runs",
        "config_is_frozen",
    }


def test_a_likely_cause_is_told_first_and_named_by_the_others() -> None:
    run = CaseRun(Case(AddsNoise.Config()))
    outcomes = [run.make(check) for check in checks_for(run.case, ["core"])]
    failed = [outcome for outcome in outcomes if not outcome.ok]
    assert failed[0].check.name == "eval_repeats_bitwise"
    assert len(failed) > 3
    told = "likely cause: that of `eval_repeats_bitwise`; mend this first"
    assert [told in outcome.message for outcome in failed] == [False] + [True] * (len(failed) - 1)


def test_a_check_alone_tells_its_own_error() -> None:
    """As with `pytest -k`: nothing is skipped for a cause that was not told."""
    mark = parametrize_with_checks([Case(CannotBeCalled.Config())]).mark
    checks = {p.id.rpartition("-")[2]: p.values[0] for p in mark.args[1]}
    with pytest.raises(pytest.fail.Exception, match="mat1 and mat2"):
        checks["sizes_vary"]()
    with pytest.raises(pytest.fail.Exception, match="mat1 and mat2"):
        checks["runs"]()
    with pytest.raises(pytest.skip.Exception, match="as `runs` does"):
        checks["sizes_vary"]()


def test_a_cause_that_went_away_excuses_nothing() -> None:
    """As with tests that are run again where they failed."""
    run = CaseRun(Case(FailsAtFirst.Config()))
    assert [
        run.make(CHECKS[name]).verdict for name in ("runs", "runs", "float64_stays_float64")
    ] == [
        "failed",
        "passed",
        "failed",
    ]
