"""Components that are sound in an unusual way pass the checks that look closest."""

from __future__ import annotations

import pytest
from contract_mutants.halves import TurnsInFull
from contract_mutants.reads import PassesFieldsOn

from qgs.contracts import Component
from qgs.testing import CHECKS, Case, run_check


@pytest.mark.parametrize(
    ("check", "component"),
    [
        ("geometry_is_float32_under_autocast", TurnsInFull),
        ("reads_within_requires", TurnsInFull),
        ("reads_within_requires", PassesFieldsOn),
    ],
)
def test_a_sound_component_passes(check: str, component: type[Component]) -> None:
    outcome = run_check(CHECKS[check], Case(component.Config()))
    assert outcome.verdict == "passed", outcome.message
