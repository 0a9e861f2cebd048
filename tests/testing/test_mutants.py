"""Every check catches a component that is broken in the one way that the check is for."""

from __future__ import annotations

import pytest
from contract_mutants import import_io, modules, options, pictures

from qgs.contracts import Component
from qgs.testing import CHECKS, Case, run_check

MUTANTS: dict[str, tuple[type[Component], dict, str]] = {
    "config_round_trip": (options.LossyConfig, {"z_offset": 0.3}, "is read again as"),
    "misspelt_option_is_refused": (options.LaxConfig, {}, "`z_offset_x` is accepted"),
    "config_is_frozen": (options.ThawedConfig, {}, "`z_offset` can be assigned to"),
    "problems_are_told": (options.NamesNoOption, {}, "the option `z_ofset`"),
    "declarations_depend_on_options_alone": (options.ChangesItsMind, {}, "`requires` gives"),
    "builds_on_meta": (options.AllocatesOnCpu, {}, "scale is allocated"),
    "registers_its_parameters": (options.HidesATensor, {}, "keeps scale outside"),
    "build_does_no_io": (options.ReadsWhenBuilt, {}, "open '/dev/null'"),
    "import_does_no_io": (import_io.ReadsAtImport, {}, "open '/dev/null'"),
    "same_seed_same_parameters": (options.DrawsElsewhere, {}, "differ: mlp.fc1.weight"),
    "build_respects_the_seed": (options.SeedsItself, {}, "torch is in one state"),
    "forward_leaves_random_state": (modules.DrawsAndForgets, {}, "draws from torch's"),
    "eval_repeats_bitwise": (modules.AddsNoise, {}, "the second time output"),
    "batch_independence": (modules.MixesScenes, {}, "scene 0 has a gradient"),
    "scene_alone_or_in_batch": (modules.CountsScenes, {}, "alone, output"),
    "query_permutation": (modules.NumbersQueries, {}, "with permuted queries"),
    "view_permutation": (modules.NumbersTokens, {}, "with permuted views"),
    "sizes_vary": (modules.KnowsSixQueries, {}, "`output` is of shape"),
    "parameters_learn": (options.HasADeadParameter, {}, "no gradient reaches unused.weight"),
    "gradients_match_differences": (modules.CutsItsGradient, {}, "Jacobian"),
    "render_gradients_match_differences": (pictures.DoublesAGradient, {}, "gaussians.colors"),
    "geometry_is_float32_under_autocast": (modules.PlacesInHalf, {}, "bfloat16, not float32"),
    "autocast_is_close": (modules.Cancels, {}, "`output` is off by"),
    "float64_stays_float64": (modules.ForgetsFloat64, {}, "`output` is 2x6x32 float32"),
    "moves_to_a_device": (modules.StaysOnCpu, {}, "device"),
    "inputs_are_not_changed": (modules.ClampsItsInput, {}, "the inputs differ: offsets"),
    "outputs_share_no_memory": (modules.ReturnsItsInput, {}, "in the memory of `features`"),
    "forward_keeps_no_state": (modules.Counts, {}, "changes calls"),
    "writes_equal_provides": (modules.WritesMore, {}, "writes place.center besides"),
    "reads_within_requires": (modules.ReadsMemoryUndeclared, {}, "reads memory.features"),
    "requires_are_read": (modules.RequiresTooMuch, {}, "requires memory.features"),
    "unmet_requirement_fails_at_compose": (modules.NeedsWhatItHides, {}, "KeyError"),
    "saved_weights_run_elsewhere": (options.DependsOnTheProcess, {}, "in a new process output"),
    "state_dict_is_complete": (options.KeepsItsNoise, {}, "with the same state dict, output"),
    "state_dict_keys": (options.RenamesItsParameters, {}, "the second instance has"),
    "zeros_stay_finite": (modules.DividesByLength, {}, "with zeros, output"),
    "large_numbers_stay_finite": (modules.Exponentiates, {}, "with inputs times 1e4, output"),
    "coincident_queries_stay_finite": (modules.DividesBySpread, {}, "with coincident queries"),
    "points_behind_cameras_stay_finite": (modules.DividesByDepth, {}, "in the centre of a camera"),
    "duplicated_view_stays_finite": (modules.DividesByBaseline, {}, "with a duplicated view"),
    "rendering_is_invariant": (pictures.KnowsTheOrigin, {}, "in a moved world, rgb"),
    "loss_is_invariant": (pictures.MeasuresFromTheOrigin, {}, "in a moved world, far"),
    "head_gives_gaussians": (modules.LongQuaternions, {}, "quaternions are 2"),
    "queries_are_shared_by_scenes": (modules.TellsScenesApart, {"count": 6}, "scene 1 of 3"),
    "queries_resize": (modules.NeverResizes, {"count": 6}, "cannot be loaded"),
    "scenes_repeat": (pictures.NeverTheSame, {"image_size": (16, 24)}, "scene 0 is"),
    "supervision_weights": (pictures.WeighsTwice, {"layers": (1, 2)}, "weights sum to 2"),
    "no_gaussians_give_the_background": (pictures.HasItsOwnBackground, {}, "not the background"),
    "rendering_is_over_the_background": (pictures.MisstatesAlpha, {}, "the background shows"),
    "loss_is_a_mean_over_scenes": (pictures.SumsOverScenes, {}, "against the mean over scenes"),
    "renderings_as_declared": (pictures.TakesTheWorstView, {}, "against the mean over views"),
    "compiles": (modules.GrowsATuple, {}, "more graphs are compiled"),
}
"""Check to the component that it must catch, its options, and what it must see."""

SLOW = {"compiles"}


def test_every_check_has_a_mutant() -> None:
    assert set(MUTANTS) == set(CHECKS)
    assert len(CHECKS) >= 24


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in MUTANTS]
)
def test_the_mutant_is_caught(name: str) -> None:
    component, options_, seen = MUTANTS[name]
    outcome = run_check(CHECKS[name], Case(component.Config(**options_)))
    assert outcome.verdict == "failed", outcome
    assert seen in outcome.message
    assert component.name in outcome.message
    assert CHECKS[name].contract in outcome.message
