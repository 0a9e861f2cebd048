"""Every check catches the components that are broken in the one way that the check is for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest
from contract_mutants import (
    broken,
    composed,
    crowds,
    depths,
    drills,
    encoding,
    graphs,
    halves,
    heads,
    import_io,
    import_weights,
    inner_options,
    io_mutants,
    learning,
    modules,
    needs,
    options,
    orders,
    pictures,
    reads,
    starts,
    traces,
    training,
    unusual,
    views,
)
from contract_mutants.company import ALSO, BROKEN
from contract_mutants.packaged.components.feed_forward import DeepInside
from contract_mutants.sound import (
    DecodesItsQueries,
    DropsOut,
    LeavesItselfOut,
    ReadsTheFirstViewMost,
    RefusesIntrinsics,
)

from qgs.contracts import Component
from qgs.testing import CHECKS, Case, checks_for, run_check


@dataclass(frozen=True)
class Mutant:
    """A check, a component that it must catch, and what it must see.

    options: of the component. case: further arguments of the case.
    """

    check: str
    component: type[Component]
    seen: str
    options: Mapping[str, Any] = field(default_factory=dict)
    case: Mapping[str, Any] = field(default_factory=dict)

    def to_case(self) -> Case:
        return Case(self.component.Config(**self.options), **self.case)

    def __str__(self) -> str:
        return f"{self.check}-{self.component.name}"


PINNED = {
    "norm.weight": (32,),
    "norm.bias": (32,),
    "mlp.fc1.weight": (128, 32),
    "mlp.fc1.bias": (128,),
    "mlp.fc2.weight": (32, 128),
    "mlp.fc2.bias": (32,),
}
"""What saved weights of `qgs/mlp` hold in a model of width 32."""

MUTANTS = [
    Mutant("builds", broken.CannotBeBuilt, "RuntimeError: no kernel for width 32"),
    Mutant("runs", broken.CannotBeCalled, "mat1 and mat2 shapes cannot be multiplied"),
    Mutant("runs", broken.ForgetsToReturn, "it gives a NoneType, not a Tensor"),
    Mutant("runs", broken.GivesNumbers, "error is no tensor"),
    Mutant("config_round_trip", options.LossyConfig, "is read again as", {"z_offset": 0.3}),
    Mutant("misspelt_option_is_refused", options.LaxConfig, "`z_offset_x` is accepted"),
    Mutant("config_is_frozen", options.ThawedConfig, "`z_offset` can be assigned to"),
    Mutant("problems_are_told", options.NamesNoOption, "the option `z_ofset`"),
    Mutant("declarations_depend_on_options_alone", options.ChangesItsMind, "`requires` gives"),
    Mutant("builds_on_meta", options.AllocatesOnCpu, "scale is allocated"),
    Mutant("registers_its_parameters", options.HidesATensor, "keeps scale outside"),
    Mutant("build_does_no_io", options.ReadsWhenBuilt, "open '/dev/null'"),
    *(
        Mutant(
            "build_does_no_io", io_mutants.ReachesOut, f"built: {event} '/dev/null", {"way": way}
        )
        for way, (_, event) in io_mutants.WAYS.items()
    ),
    Mutant("import_does_no_io", import_weights.LoadsAtImport, "safetensors.safe_open 'nowhere"),
    Mutant("import_does_no_io", DeepInside, "os.listdir '.'"),
    Mutant("import_does_no_io", import_io.ReadsAtImport, "open '/dev/null'"),
    Mutant("same_seed_same_parameters", options.DrawsElsewhere, "differ: mlp.fc1.weight"),
    Mutant("build_respects_the_seed", options.SeedsItself, "torch is in one state"),
    Mutant("forward_leaves_random_state", modules.DrawsAndForgets, "draws from torch's"),
    Mutant("eval_repeats_bitwise", modules.AddsNoise, "the second time output"),
    Mutant("batch_independence", modules.MixesScenes, "scene 0 has a gradient"),
    Mutant("scene_alone_or_in_batch", modules.CountsScenes, "alone, output"),
    Mutant("query_permutation", modules.NumbersQueries, "permuted queries"),
    Mutant("view_permutation", modules.NumbersTokens, "permuted views"),
    Mutant("sizes_vary", modules.KnowsSixQueries, "`output` is of shape"),
    Mutant("sizes_vary", heads.KnowsTwoHeads, "in a model of width 48 with 3 heads, RuntimeError"),
    Mutant("sizes_vary", heads.KnowsItsWidth, "(2, 6, 32), not (2, 6, 48)"),
    Mutant("parameters_learn", options.HasADeadParameter, "no gradient reaches unused.weight"),
    Mutant("gradients_match_differences", modules.CutsItsGradient, "Jacobian"),
    Mutant("render_gradients_match_differences", pictures.DoublesAGradient, "gaussians.colors"),
    Mutant("geometry_is_float32_under_autocast", modules.PlacesInHalf, "bfloat16, not float32"),
    Mutant("autocast_is_close", modules.Cancels, "`output` is off by"),
    Mutant("float64_stays_float64", modules.ForgetsFloat64, "`output` is 2x6x32 float32"),
    Mutant("moves_to_a_device", modules.StaysOnCpu, "device"),
    Mutant("inputs_are_not_changed", modules.ClampsItsInput, "the inputs differ: offsets"),
    Mutant("outputs_share_no_memory", modules.ReturnsItsInput, "in the memory of `features`"),
    Mutant("forward_keeps_no_state", modules.Counts, "changes calls"),
    Mutant("writes_equal_provides", modules.WritesMore, "writes place.center besides"),
    Mutant("reads_within_requires", modules.ReadsMemoryUndeclared, "reads memory.features"),
    Mutant("requires_are_read", modules.RequiresTooMuch, "requires memory.features"),
    Mutant("unmet_requirement_fails_at_compose", modules.NeedsWhatItHides, "KeyError"),
    Mutant("unmet_requirement_fails_at_compose", needs.NeedsTwoSaysOne, "KeyError: 'size'"),
    Mutant("saved_weights_run_elsewhere", options.DependsOnTheProcess, "in a new process output"),
    Mutant("state_dict_is_complete", options.KeepsItsNoise, "with the same state dict, output"),
    Mutant("state_dict_keys", options.RenamesItsParameters, "the second instance has"),
    Mutant("zeros_stay_finite", modules.DividesByLength, "with zeros, output"),
    Mutant("large_numbers_stay_finite", modules.Exponentiates, "with inputs times 1e4, output"),
    Mutant("coincident_queries_stay_finite", modules.DividesBySpread, "with coincident queries"),
    Mutant(
        "points_behind_cameras_stay_finite", modules.DividesByDepth, "in the centre of a camera"
    ),
    Mutant("duplicated_view_stays_finite", modules.DividesByBaseline, "with a duplicated view"),
    Mutant("rendering_is_invariant", pictures.KnowsTheOrigin, "in a moved world, rgb"),
    Mutant("loss_is_invariant", pictures.MeasuresFromTheOrigin, "in a moved world, far"),
    Mutant("head_gives_gaussians", modules.LongQuaternions, "quaternions are 2"),
    Mutant("queries_are_shared_by_scenes", modules.TellsScenesApart, "scene 1 of 3", {"count": 6}),
    Mutant("queries_resize", modules.NeverResizes, "cannot be loaded", {"count": 6}),
    Mutant("scenes_repeat", pictures.NeverTheSame, "scene 0 is", {"image_size": (16, 24)}),
    Mutant("supervision_weights", pictures.WeighsTwice, "weights sum to 2", {"layers": (1, 2)}),
    Mutant("no_gaussians_give_the_background", pictures.HasItsOwnBackground, "not the background"),
    Mutant("rendering_is_over_the_background", pictures.MisstatesAlpha, "the background shows"),
    Mutant("loss_is_a_mean_over_scenes", pictures.SumsOverScenes, "against the mean over scenes"),
    Mutant("renderings_as_declared", pictures.TakesTheWorstView, "against the mean over views"),
    Mutant("compiles", modules.GrowsATuple, "more graphs are compiled"),
    Mutant("reads_within_requires", reads.ReadsAnothersFieldIfThere, "reads anchor.center"),
    Mutant("reads_within_requires", reads.LooksForAField, "reads anchor.center"),
    Mutant("reads_within_requires", reads.ReadsInTry, "reads anchor.center"),
    Mutant("reads_within_requires", reads.ReadsWhatItCopies, "reads anchor.raw_radius"),
    Mutant("reads_within_requires", reads.ReadsInTraining, "reads anchor.center"),
    Mutant("reads_within_requires", reads.SearchesTheFields, "goes through all fields"),
    Mutant("reads_within_requires", reads.PeeksAtTheRendering, "although `renderings` is none"),
    Mutant("reads_within_requires", reads.DrawsAnchorsIn, "reads anchor.raw_radius"),
    Mutant("geometry_is_float32_under_autocast", halves.MatmulThenFloat, "output: values differ"),
    Mutant("geometry_is_float32_under_autocast", halves.TurnsInHalf, "place.center: values differ"),
    Mutant("geometry_is_float32_under_autocast", halves.LinearThenFloat, "place.center: values"),
    Mutant(
        "geometry_is_float32_under_autocast",
        halves.PlacesQueriesInHalf,
        "place.center",
        {"count": 6},
    ),
    Mutant("geometry_is_float32_under_autocast", halves.DecodesInHalf, "opacities: values differ"),
    Mutant("geometry_is_float32_under_autocast", halves.BiasesInHalf, "explain.geometry"),
    Mutant("geometry_is_float32_under_autocast", halves.MeasuresInHalf, "volume: values differ"),
    Mutant("batch_independence", training.BatchNormed, "in training, scene 0 has a gradient"),
    Mutant("batch_independence", training.CentresOnTheBatch, "in training, beside another scene"),
    Mutant("inputs_are_not_changed", training.MutatesInTraining, "forward pass in training"),
    Mutant("forward_keeps_no_state", training.CountsInTraining, "in training changes _steps"),
    Mutant("forward_keeps_no_state", training.BatchNormed, "in training changes the state"),
    Mutant("forward_keeps_no_state", training.KeepsACache, "changes _cache"),
    Mutant("forward_keeps_no_state", training.KeepsALog, "KeepsALog._log['last'][0]"),
    Mutant("forward_keeps_no_state", training.SmoothsItsNoise, "changes the state: seen"),
    Mutant("training_draws_from_torch", training.SeedsInTraining, "torch is in one state"),
    Mutant("training_draws_from_torch", training.DropsByNumpy, "numpy's or random's"),
    Mutant("training_draws_from_torch", training.DropsByPython, "numpy's or random's"),
    Mutant("training_draws_from_torch", training.DropsByItsOwnGenerator, "from one seed differ"),
    Mutant("view_permutation", views.DeclaresAnOrder, "`ordered_views` is declared"),
    Mutant("view_permutation", views.DeclaresAnOrderOfPhotos, "`ordered_views` is declared"),
    Mutant("view_permutation", views.NumbersPhotos, "permuted views"),
    Mutant("view_permutation", views.DimsLaterViews, "permuted views, depth"),
    Mutant("view_permutation", views.WeighsTheFirstView, "permuted views, error"),
    Mutant("gradients_match_differences", learning.DetachedLoss, "but has no gradient"),
    Mutant("terms_have_gradients", learning.DetachedLoss, "of the term error"),
    Mutant("terms_have_gradients", learning.HasAnIdleTerm, "of the term contrast"),
    Mutant("gradients_reach_inputs", learning.DetachedAttention, "memory.keys, memory.values"),
    Mutant("gradients_reach_inputs", learning.IgnoresWhereItIs, "state.fields.place.center"),
    Mutant("gradients_reach_inputs", learning.LearnsAConstant, "no gradient reaches features"),
    Mutant("gradients_reach_inputs", learning.StandsStill, "no gradient reaches offsets"),
    Mutant("unmet_requirement_fails_at_compose", learning.TakesRootsOfZero, "gradients are not"),
    Mutant("memory_depends_on_images", learning.ClosesItsEyes, "`values` stays as it is"),
    Mutant("render_gradients_match_differences", learning.ForgetsDepth, "`gaussians.means`"),
    Mutant("camera_gradients_match_differences", learning.TurnsPosesOnly, "`cameras.c2w`"),
    Mutant("camera_gradients_match_differences", learning.HoldsItsLens, "and gets none"),
    Mutant("camera_gradients_match_differences", learning.RefusesWhatItDeclares, "is refused"),
    Mutant("camera_gradients_match_differences", learning.DeclaresAGradientInSize, "names size"),
    Mutant("head_gives_gaussians", starts.StartsWithoutATurn, "with initial parameters"),
    Mutant("same_parameters_elsewhere", starts.DrawsInTheOrderOfASet, "another process draws"),
    Mutant("head_gives_gaussians", drills.LongQuaternionsInTraining, "in training, with initial"),
    Mutant("zeros_stay_finite", drills.DividesByLengthInTraining, "in training, with zeros"),
    Mutant("sizes_vary", drills.LosesAQueryInTraining, "in training, with Sizes"),
    Mutant("compiles", graphs.CutsItsGradientCompiled, "features has a gradient"),
    Mutant("compiles", graphs.LoopsOverQueries, "4 more graphs are compiled"),
    Mutant("compiles", graphs.LoopsOverViews, "4 more graphs are compiled"),
    Mutant("depth_is_expected", depths.LosesDepth, "depth is off by"),
    Mutant("depth_is_expected", depths.SquashesDepth, "depth is off by"),
    Mutant("render_gradients_match_differences", depths.DetachesDepth, "`gaussians.means`"),
    Mutant("render_gradients_match_differences", depths.DetachesAlpha, "`gaussians.means`"),
    Mutant("camera_gradients_match_differences", depths.DetachesDepth, "`cameras.c2w`"),
    Mutant("camera_gradients_match_differences", depths.DetachesAlpha, "`cameras.c2w`"),
    Mutant("no_gaussians_give_the_background", depths.CountsWhatIsThere, "of c2w"),
    Mutant("rendering_is_invariant", orders.DarkensTheSky, "in a moved world, rgb"),
    Mutant("loss_is_invariant", orders.KnowsWhatIsUp, "in a moved world, spread"),
    Mutant("query_permutation", orders.WatchesTheFirstQuery, "6 permuted queries, size"),
    Mutant("query_permutation", orders.NumbersGaussians, "6 permuted queries, rgb"),
    Mutant("query_permutation", orders.DropsQueriesInTraining, "in training, with 6 permuted"),
    Mutant("view_permutation", orders.DropsAViewInTraining, "in training, with 3 permuted"),
    Mutant("query_permutation", crowds.Windowed, "with 200 permuted queries"),
    Mutant("view_permutation", crowds.FirstTokens, "permuted views, output"),
    Mutant("query_permutation", crowds.FirstGaussians, "with 200 permuted queries"),
    Mutant("batch_independence", crowds.MixesManyScenes, "scene 0 has a gradient"),
    Mutant("state_dict_keys", options.MovesItsNorm, "'norm.bias'", case={"state_dict": PINNED}),
    Mutant("state_dict_keys", options.HalvesItsMlp, "(128, 32)", case={"state_dict": PINNED}),
    Mutant("patch_rays_are_those_of_the_grid", encoding.ForgetsItsRays, "differ by up to 0.9"),
    Mutant("patch_rays_are_those_of_the_grid", encoding.RoundsItsRays, "of patches of 8 pixels"),
    Mutant("patch_rays_are_those_of_the_grid", encoding.TurnsItsGrid, "`grid` is (2, 3, 2), whi"),
    Mutant("tokens_are_those_of_the_grid", encoding.GoesByColumns, "token of `keys` at (1, 1, 1)"),
    Mutant("tokens_are_those_of_the_grid", encoding.MixesUpItsViews, "`values` at (0, 0, 2)"),
    Mutant("tokens_are_those_of_the_grid", encoding.FlipsTallImages, "with images of 24 x 16, a"),
    Mutant("unmet_requirement_fails_at_compose", composed.ViewsAField, "view size is not"),
    Mutant("layout_makes_no_difference", composed.ViewsAField, "view size is not"),
    Mutant("memo_is_of_the_memory_alone", composed.SharesItsProjection, "depends on a weight"),
    Mutant("unmet_requirement_fails_at_compose", composed.SharesItsProjection, "layer 2 no grad"),
    Mutant("memo_is_of_the_memory_alone", composed.KeepsTheFirstState, "depends on the state"),
    Mutant(
        "explanation_is_of_the_forward_pass",
        composed.ExplainsNoBias,
        "the weights change otherwise",
    ),
    Mutant("explanation_is_a_softmax", composed.ExplainsWithoutSoftmax, "off the softmax"),
    Mutant("geometry_is_float32_under_autocast", composed.BiasesInHalfUntold, "by matmul is in"),
    Mutant("geometry_is_float32_under_autocast", traces.KeepsItsRadiusInHalf, "place.radius: val"),
    Mutant("geometry_is_float32_under_autocast", traces.PlacesInHalfInTraining, "in training"),
    Mutant("writes_equal_provides", traces.WritesMoreInTraining, "in training it writes place.st"),
    Mutant("float64_stays_float64", traces.FloatInTraining, "in training `output` is 2x6x32 fl"),
    Mutant("gradients_match_differences", traces.CutsInTraining, "in training: Jacobian"),
    Mutant("parameters_learn", traces.LearnsFromNoise, "no gradient reaches lift"),
    Mutant("gradients_reach_inputs", traces.DetachesLaterGaussians, "reaches [0, 1], [1, 1]"),
    Mutant("gradients_match_differences", traces.DetachesLaterGaussians, "Jacobian"),
    Mutant("forward_keeps_no_state", traces.KeepsACallableMemo, "changes first.means"),
    Mutant("forward_keeps_no_state", traces.KeepsAMemoInAClosure, "another one differs"),
    Mutant("saved_weights_run_elsewhere", traces.KeepsAMemoForAll, "in a new process output"),
    Mutant("outputs_share_no_memory", traces.ReturnsItsBuffer, "in the memory of `home`"),
    Mutant("config_round_trip", inner_options.LosesAnOption, "is read again as"),
    Mutant("config_round_trip", inner_options.RoundsOtherValues, "is read again as"),
    Mutant("misspelt_option_is_refused", inner_options.LaxInside, "of Inner is accepted"),
    Mutant("options_are_left_alone", inner_options.AppendsToAnOption, "when it is built, Config"),
]

SLOW = {graphs.LoopsOverQueries, graphs.LoopsOverViews}


def test_every_check_has_a_mutant() -> None:
    assert {mutant.check for mutant in MUTANTS} == set(CHECKS)
    assert len(CHECKS) >= 24


@pytest.mark.parametrize(
    "mutant",
    [pytest.param(m, marks=[pytest.mark.slow] if m.component in SLOW else []) for m in MUTANTS],
    ids=str,
)
def test_the_mutant_is_caught(mutant: Mutant) -> None:
    check = CHECKS[mutant.check]
    outcome = run_check(check, mutant.to_case())
    assert outcome.verdict == "failed", outcome
    assert mutant.seen in outcome.message
    assert mutant.component.name in outcome.message
    assert check.contract in outcome.message


@pytest.mark.parametrize(
    "component", dict.fromkeys(m.component for m in MUTANTS if m.component.name not in BROKEN)
)
def test_no_other_check_fails(component: type[Component]) -> None:
    mutants = [mutant for mutant in MUTANTS if mutant.component is component]
    case = mutants[0].to_case()
    outcomes = [run_check(check, case) for check in checks_for(case, ["core"])]
    failed = {outcome.check.name: outcome.message for outcome in outcomes if not outcome.ok}
    alike = [m for m in mutants if (m.options, m.case) == (mutants[0].options, mutants[0].case)]
    meant = {m.check for m in alike if CHECKS[m.check].tier == "core"}
    expected = meant | ALSO.get(component.name, {}).keys()
    assert failed.keys() == expected, [failed[name] for name in failed.keys() - expected]


@pytest.mark.parametrize(
    "component",
    [
        DecodesItsQueries,
        DropsOut,
        LeavesItselfOut,
        ReadsTheFirstViewMost,
        RefusesIntrinsics,
        unusual.TurnsAutocastOff,
        unusual.FusesInHalf,
        unusual.LooksNowhere,
        unusual.WeighsNothing,
        unusual.Recurrent,
        unusual.MovesItsState,
    ],
)
def test_what_is_sound_passes(component: type[Component]) -> None:
    case = Case(component.Config())
    failed = [
        o.message for o in (run_check(c, case) for c in checks_for(case, ["core"])) if not o.ok
    ]
    assert not failed
