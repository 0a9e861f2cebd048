"""Components that are sound in an unusual way, or of an unusual size, pass."""

from __future__ import annotations

import pytest
from contract_mutants.halves import TurnsInFull
from contract_mutants.reads import PassesFieldsOn
from contract_mutants.sound_encoders import SeesFar

from qgs.components import ContentCrossAttention
from qgs.contracts import ModelDims
from qgs.testing import CHECKS, Case, run_check

THREE_HEADS = ModelDims(width=48, heads=3, depth=1)


@pytest.mark.parametrize(
    ("check", "case"),
    [
        ("geometry_is_float32_under_autocast", Case(TurnsInFull.Config())),
        ("reads_within_requires", Case(TurnsInFull.Config())),
        ("reads_within_requires", Case(PassesFieldsOn.Config())),
        ("tokens_are_those_of_the_grid", Case(SeesFar.Config())),
        ("tokens_are_those_of_the_grid", Case(SeesFar.Config(depth=8, layer_scale=1.0))),
        ("saved_weights_run_elsewhere", Case(ContentCrossAttention.Config(), THREE_HEADS)),
    ],
)
def test_a_sound_component_passes(check: str, case: Case) -> None:
    outcome = run_check(CHECKS[check], case)
    assert outcome.verdict == "passed", outcome.message
