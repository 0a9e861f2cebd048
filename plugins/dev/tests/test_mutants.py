"""Every check catches the components that are broken in the way that it is for."""

from importlib import import_module
from pathlib import Path

import pytest
from contract_mutants import sound
from contract_mutants.mutant import MUTANTS, SOUND
from qgs_dev import CHECKS, Case, CaseRun, run_check

from qgs.contracts import ModelDims
from qgs.renderers import TorchRenderer
from qgs.tokengs import ContentCrossAttention

for file in sorted(Path(sound.__file__).parent.glob("*.py")):
    import_module(f"contract_mutants.{file.stem}")

pytestmark = pytest.mark.slow


def test_every_check_has_a_mutant():
    assert {mutant.check for mutant in MUTANTS} == set(CHECKS)


@pytest.mark.parametrize("mutant", MUTANTS, ids=str)
def test_the_mutant_is_caught_by_the_check_that_is_meant(mutant):
    meant = CHECKS[mutant.check]
    result = run_check(meant, mutant.case)
    assert result.verdict == "failed", result
    assert mutant.seen in result.message
    assert mutant.case.component.name in result.message
    assert meant.contract in result.message


@pytest.mark.parametrize("case", SOUND)
def test_a_sound_component_passes(case):
    CaseRun(case).check(["core"])


GRID = ("tokens_are_those_of_the_grid",)
GRADIENTS = ("render_gradients_match_differences", "camera_gradients_match_differences")
RENDERED = [("dilation", 0.1), ("dilation", 1.0), ("alpha_min", 1 / 128), ("background", (0, 0, 0))]


@pytest.mark.parametrize(
    ("checks", "case"),
    [
        (GRID, Case(sound.SeesFar.Config(depth=8, layer_scale=1.0))),
        *[
            (GRID, Case(encoder.Config(patch_size=patch), image_size=size))
            for encoder in (sound.ConvolvesByThree, sound.ConvolvesByFour)
            for patch, size in [(4, None), (16, None), (8, (64, 64)), (8, (16, 24))]
        ],
        (["construction"], Case(ContentCrossAttention.Config(), ModelDims(48, 3, 1))),
        *[(GRADIENTS, Case(TorchRenderer.Config(**{option: value}))) for option, value in RENDERED],
        (GRADIENTS, Case(TorchRenderer.Config(), image_size=(17, 23))),
    ],
)
def test_a_sound_component_of_unusual_options_passes(checks, case):
    for name in checks:
        CHECKS[name].function(case)
