"""How checks are run and reported: causes, places of errors, expected failures, arguments."""

from importlib import import_module
from pathlib import Path

import pytest
from contract_mutants import modules
from contract_mutants.modules import CachesByShape, IgnoresUnknownOptions, RaisesWhenBuilt
from contract_mutants.spatial import Steps, TurnsInFull
from qgs_plugintools import (
    CHECKS,
    Case,
    CaseRun,
    checks_for,
    parametrize_with_checks,
    run_check,
)
from torch import Tensor

from qgs.components import FreeCenters, MlpFeedForward
from qgs.contracts import Centers, Component, ViewsConfig

CASE = Case(MlpFeedForward.Config())
CACHES = Case(CachesByShape.Config())
STATE, FROZEN = "forward_keeps_no_state", "config_round_trip"


def bound(cases: list[Case], **options) -> dict:
    """The checks as pytest calls them, by the ids of their tests."""
    mark = parametrize_with_checks(cases, **options).mark
    return {parameter.id: parameter.values[0] for parameter in mark.args[1]}


def test_a_failure_says_what_was_seen_and_what_the_contract_says() -> None:
    with pytest.raises(pytest.fail.Exception) as failure:
        bound([CACHES])[f"feed_forward/caches_by_shape-{STATE}"]()
    title, seen, contract = str(failure.value).splitlines()
    assert title == f"feed_forward/caches_by_shape: {STATE}"
    assert seen.startswith("  seen: ")
    assert contract == f"  contract: {CHECKS[STATE].contract}"


def test_an_error_is_reported_with_its_place_in_the_component() -> None:
    file = Path(modules.__file__)
    culprit = "raise RuntimeError"
    line = 1 + [culprit in text for text in file.read_text().splitlines()].index(True)
    result = run_check(CHECKS["builds"], Case(RaisesWhenBuilt.Config()))
    assert f" (raised under {file}:{line})\n" in result.message


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
    result = run_check(CHECKS["runs"], Case(placed.Config()))
    assert f"(raised under {package / 'maths.py'}:5)" in result.message


def test_one_cause_is_one_failure() -> None:
    run = CaseRun(Case(RaisesWhenBuilt.Config()))
    results = [run.make(check) for check in checks_for(run.case, ["core"])]
    assert [r.check.name for r in results if not r.ok] == ["builds"]
    assert {r.verdict for r in results[1:]} == {"skipped"}


class FailsAtFirst(MlpFeedForward):
    name = "fails_at_first"
    calls = 0

    def forward(self, features: Tensor) -> Tensor:
        FailsAtFirst.calls += 1
        if FailsAtFirst.calls == 1:
            raise RuntimeError("not now")
        return super().forward(features)


def test_a_cause_that_went_away_skips_nothing() -> None:
    """As with tests that are run again where they failed."""
    run = CaseRun(Case(FailsAtFirst.Config()))
    verdicts = [run.make(CHECKS[name]).verdict for name in ("runs", "sizes_vary", "runs", FROZEN)]
    assert verdicts == ["failed", "skipped", "passed", "passed"]


def test_tiers_divide_the_checks_and_likely_causes_come_first() -> None:
    core, extended = (checks_for(CASE, [tier]) for tier in ("core", "extended"))
    assert [check.name for check in core[:4]] == ["builds", "runs", STATE, "eval_repeats_bitwise"]
    assert [check.name for check in extended] == ["compiles"]
    assert len(core) + len(extended) == len(checks_for(CASE))


def test_expected_failures_are_strict() -> None:
    checks = bound([CACHES], expected_failures={STATE: "a cache", FROZEN: "it might"})
    with pytest.raises(pytest.xfail.Exception, match=r"a cache \(seen: .* changes _cache"):
        checks[f"{CACHES.label}-{STATE}"]()
    with pytest.raises(pytest.fail.Exception, match="passes"):
        checks[f"{CACHES.label}-{FROZEN}"]()


def test_expected_failures_may_depend_on_the_case() -> None:
    unbounded, bounded = FreeCenters.Config(output_limit=None), FreeCenters.Config()
    name = "large_numbers_stay_finite"
    given = {unbounded: {name: "it has no limit"}, bounded: {}}
    checks = bound(
        [Case(config) for config in given], expected_failures=lambda case: given[case.config]
    )
    first, second = (check for label, check in checks.items() if label.endswith(name))
    with pytest.raises(pytest.xfail.Exception, match="it has no limit"):
        first()
    second()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("config_round_tip", "why"),
        ("supervision_weights", "why"),
        ("runs", "why"),
        (FROZEN, " "),
        (FROZEN, 3),
    ],
)
def test_expected_failures_that_cannot_be_are_refused(name, expected) -> None:
    for given in ({name: expected}, lambda case: {name: expected}):
        with pytest.raises(ValueError, match=name):
            parametrize_with_checks([CACHES], expected_failures=given)


@pytest.mark.parametrize("given", [CASE, MlpFeedForward.Config(), [MlpFeedForward], "mlp", []])
def test_what_is_no_list_of_cases_is_refused(given) -> None:
    with pytest.raises(TypeError):
        parametrize_with_checks(given)


class Slotless(Component):
    name = "slotless"


class Formless(Centers):
    name = "formless"


@pytest.mark.parametrize(
    "given",
    [MlpFeedForward, ViewsConfig(), Slotless.Config(), Centers.Config(), Formless.Config()],
)
def test_what_cannot_be_checked_is_refused(given) -> None:
    with pytest.raises(TypeError):
        Case(given)


def test_fields_of_a_case_are_those_of_its_component() -> None:
    assert Case(TurnsInFull.Config(), fields={"place.center": abs}).fields
    with pytest.raises(ValueError, match=r"did you mean `place\.center`"):
        Case(Steps.Config(), fields={"place.centre": abs})


def test_a_check_of_another_slot_is_refused() -> None:
    with pytest.raises(ValueError, match="is not for centers/ignores_unknown_options"):
        run_check(CHECKS["head_gives_gaussians"], Case(IgnoresUnknownOptions.Config()))


@pytest.mark.parametrize("tiers", ["core", (), ["cor"], ["core", "all"]])
def test_unknown_tiers_are_refused(tiers) -> None:
    with pytest.raises(ValueError, match="core, extended"):
        parametrize_with_checks([CASE], tiers=tiers)
