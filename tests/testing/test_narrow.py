"""One number for each query, and a look for a field by `in` of the state itself."""

from __future__ import annotations

from contract_mutants.narrow import LooksForAFieldOfTheState, ShiftsByOneNumber

from qgs.testing import CHECKS, Case, run_check


def test_narrow_outputs_are_the_same_bits_in_another_process() -> None:
    check = CHECKS["saved_weights_run_elsewhere"]
    outcome = run_check(check, Case(ShiftsByOneNumber.Config()))
    assert outcome.verdict == "passed", outcome.message


def test_a_look_for_a_field_of_the_state_is_noted() -> None:
    check = CHECKS["reads_within_requires"]
    outcome = run_check(check, Case(LooksForAFieldOfTheState.Config()))
    assert "it reads someones.field, which it does not require" in outcome.message
