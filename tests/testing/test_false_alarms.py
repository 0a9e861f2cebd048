"""Components that are sound in an unusual way, or of an unusual size, pass."""

from __future__ import annotations

import pytest
from contract_mutants.halves import TurnsInFull
from contract_mutants.reads import PassesFieldsOn
from contract_mutants.sound import Fades
from contract_mutants.sound_encoders import SeesFar

from qgs.components import ContentCrossAttention
from qgs.contracts import ModelDims
from qgs.renderers import TorchRenderer
from qgs.testing import CHECKS, Case, run_check

DIFFERENCES = ("render_gradients_match_differences", "camera_gradients_match_differences")
THREE_HEADS = ModelDims(width=48, heads=3, depth=1)


@pytest.mark.parametrize(
    ("check", "case"),
    [
        ("geometry_is_float32_under_autocast", Case(TurnsInFull.Config())),
        ("reads_within_requires", Case(TurnsInFull.Config())),
        ("reads_within_requires", Case(PassesFieldsOn.Config())),
        ("tokens_are_those_of_the_grid", Case(SeesFar.Config())),
        ("tokens_are_those_of_the_grid", Case(SeesFar.Config(depth=8, layer_scale=1.0))),
        *(
            (check, case)
            for check in (
                "render_gradients_match_differences",
                "camera_gradients_match_differences",
            )
            for case in (
                Case(TorchRenderer.Config(dilation=0.1)),
                Case(TorchRenderer.Config(dilation=1.0)),
                Case(TorchRenderer.Config(alpha_min=1 / 128)),
                Case(TorchRenderer.Config(background=(0, 0, 0))),
                Case(TorchRenderer.Config(), image_size=(17, 23)),
                Case(Fades.Config()),
            )
        ),
        ("saved_weights_run_elsewhere", Case(ContentCrossAttention.Config(), THREE_HEADS)),
    ],
)
def test_a_sound_component_passes(check: str, case: Case) -> None:
    outcome = run_check(CHECKS[check], case)
    assert outcome.verdict == "passed", outcome.message
