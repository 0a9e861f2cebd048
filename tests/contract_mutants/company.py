"""What a mutant fails besides the checks that are meant for it, and why it cannot but do so."""

from __future__ import annotations

from collections.abc import Mapping


def _because(reason: str, *checks: str) -> dict[str, str]:
    return dict.fromkeys(checks, reason)


ALSO: Mapping[str, Mapping[str, str]] = {
    "forgets_to_return": _because(
        "there is no output",
        "unmet_requirement_fails_at_compose",
        "gradients_reach_inputs",
        "parameters_learn",
        "sizes_vary",
    ),
    "gives_numbers": _because(
        "a number is no term", "terms_have_gradients", "renderings_as_declared"
    ),
    "lossy_config": _because(
        "another process reads the options from text", "saved_weights_run_elsewhere"
    ),
    "names_no_option": _because(
        "no recipe takes what always finds a problem", "unmet_requirement_fails_at_compose"
    ),
    "changes_its_mind": _because(
        "it requires other fields each time it is asked",
        "unmet_requirement_fails_at_compose",
        "gradients_reach_inputs",
        "batch_independence",
        "requires_are_read",
        "saved_weights_run_elsewhere",
    ),
    "allocates_on_cpu": _because("nothing uses the parameter", "parameters_learn"),
    "adds_noise": _because(
        "no two passes agree",
        "forward_leaves_random_state",
        "query_permutation",
        "layout_makes_no_difference",
        "saved_weights_run_elsewhere",
        "state_dict_is_complete",
        "scene_alone_or_in_batch",
    ),
    "mixes_scenes": _because("a mean over one scene is another", "scene_alone_or_in_batch"),
    "knows_six_queries": {
        "query_permutation": "its parameters have an order",
        "gradients_match_differences": "it is made with three queries",
        "batch_independence": "it is made with two hundred queries too",
    },
    "divides_by_baseline": _because(
        "baselines are measured from the first view", "view_permutation"
    ),
    "loses_a_query_in_training": _because("it is made with 200 queries too", "query_permutation"),
    "forgets_float64": _because(
        "differences in float32 are too coarse", "gradients_match_differences"
    ),
    "clamps_its_input": {
        "gradients_reach_inputs": "it takes the data out of the graph",
        "geometry_is_float32_under_autocast": "what it clamps is changed for the second pass",
    },
    "returns_its_input": _because("its parameters stay unused", "parameters_learn"),
    "writes_more": _because(
        "what it writes is of the features' dtype", "geometry_is_float32_under_autocast"
    ),
    "requires_too_much": _because("what is not read gets no gradient", "gradients_reach_inputs"),
    "keeps_its_noise": _because("another process draws other noise", "saved_weights_run_elsewhere"),
    "renames_its_parameters": {
        "parameters_learn": "nothing uses the parameter",
        **_because(
            "no other instance has the same names",
            "same_seed_same_parameters",
            "same_parameters_elsewhere",
            "saved_weights_run_elsewhere",
            "state_dict_is_complete",
        ),
    },
    "divides_by_spread": {
        "zeros_stay_finite": "zeros coincide",
        "query_permutation": "the spread is that around the first query",
        **_because(
            "the spread is that of all scenes", "batch_independence", "scene_alone_or_in_batch"
        ),
    },
    "divides_by_depth": _because("its depth is 0 there too", "zeros_stay_finite"),
    "has_its_own_background": _because(
        "another background changes nothing", "rendering_is_over_the_background"
    ),
    "grows_a_tuple": {
        "forward_keeps_no_state": "the tuple is an attribute",
        **_because(
            "its length rounds differently each time",
            "saved_weights_run_elsewhere",
            "training_draws_from_torch",
            "eval_repeats_bitwise",
        ),
    },
    "reads_what_it_copies": _because(
        "the field that it tempts with has another size", "requires_are_read"
    ),
    "places_queries_in_half": _because("its matrix is made on the CPU", "builds_on_meta"),
    **dict.fromkeys(
        ("drops_by_numpy", "drops_by_python", "drops_by_its_own_generator"),
        _because(
            "no two training passes agree",
            "batch_independence",
            "query_permutation",
            "gradients_match_differences",
            "forward_keeps_no_state",
        ),
    ),
    "batch_normed": _because("one query of one scene has no statistics", "sizes_vary"),
    "numbers_gaussians": _because("it fades what depth is weighted by", "depth_is_expected"),
    "dims_later_views": _because("it dims depth", "depth_is_expected"),
    "takes_roots_of_zero": _because(
        "its gradient is nowhere a number",
        "batch_independence",
        "gradients_match_differences",
        "zeros_stay_finite",
        "large_numbers_stay_finite",
        "coincident_queries_stay_finite",
    ),
    "draws_elsewhere": _because(
        "no two instances are alike", "forward_keeps_no_state", "same_parameters_elsewhere"
    ),
    "misstates_alpha": _because("two depths are weighed by alpha", "depth_is_expected"),
    "centres_on_the_batch": _because(
        "the mean that it detaches moves", "gradients_match_differences"
    ),
    "mutates_in_training": _because(
        "the next pass is given other numbers",
        "gradients_match_differences",
        "forward_keeps_no_state",
    ),
    "float_in_training": _because(
        "differences in float32 are too coarse", "gradients_match_differences"
    ),
    **dict.fromkeys(
        ("keeps_a_callable_memo", "keeps_a_memo_in_a_closure"),
        _because("another process was called otherwise before", "saved_weights_run_elsewhere"),
    ),
    "learns_a_constant": _because("the norm of zeros is zero", "parameters_learn"),
    "refuses_what_it_declares": _because(
        "gradients in what is declared are asked for there",
        "no_gaussians_give_the_background",
        "gradients_reach_inputs",
        "batch_independence",
        "zeros_stay_finite",
        "large_numbers_stay_finite",
        "coincident_queries_stay_finite",
        "points_behind_cameras_stay_finite",
        "duplicated_view_stays_finite",
        "inputs_are_not_changed",
    ),
    "turns_its_grid": _because("it has no patches", "tokens_are_those_of_the_grid"),
    "mixes_up_its_views": _because("whose values a view gets depends on order", "view_permutation"),
}
"""Name of a mutant -> check -> why it fails that one too."""

BROKEN: Mapping[str, str] = {
    "cannot_be_built": "nothing can be asked of it",
    "cannot_be_called": "nothing can be asked of its forward pass",
    "needs_what_it_hides": "no forward pass without the field",
    "needs_two_says_one": "no forward pass without the field",
}
"""Name of a mutant -> why it may fail any check."""
