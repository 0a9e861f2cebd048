"""Cases and tiers that are none are refused with what to write."""

from __future__ import annotations

import pytest
from contract_mutants.modules import Counts

from qgs.components import MlpFeedForward
from qgs.contracts import Centers, Component, ViewsConfig
from qgs.testing import Case, check_plugin, checks_for, parametrize_with_checks

CASE = Case(MlpFeedForward.Config())
EXAMPLE = r"give \[Case\(MlpFeedForward.Config\("


class Slotless(Component):
    name = "slotless"


class Formless(Centers):
    name = "formless"


class Nameless(MlpFeedForward):
    name = None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (CASE, r"the one case feed_forward/mlp; give \[Case\(...\)\]"),
        (MlpFeedForward, f"the class MlpFeedForward; {EXAMPLE}"),
        (MlpFeedForward.Config, f"the class MlpFeedForward.Config; {EXAMPLE}"),
        (MlpFeedForward.Config(), f"the options Config.*; {EXAMPLE}..."),
        (
            lambda check: check(),
            r"the function .*<lambda>; give \[Case\(MyComponent.Config\(\)\)\]",
        ),
        ("mlp", r"'mlp'; give \[Case\(MyComponent"),
        (None, r"None; give \[Case\(MyComponent"),
        ([MlpFeedForward], r"the class MlpFeedForward is no case; give Case\(MlpFeedForward.Con"),
        ([CASE, MlpFeedForward.Config()], r"is no case; give Case\(MlpFeedForward.Config\(...\)\)"),
        ([MlpFeedForward.Config], r"is no case; give Case\(MlpFeedForward.Config\(\)\)"),
        ([3], r"3 is no case; give Case\(MyComponent.Config\(\)\)"),
    ],
)
def test_what_is_no_list_of_cases_is_refused(given, message) -> None:
    with pytest.raises(TypeError, match=message):
        parametrize_with_checks(given)


def test_there_must_be_a_case() -> None:
    with pytest.raises(ValueError, match="there are no cases to check"):
        parametrize_with_checks([])
    assert parametrize_with_checks(case for case in [CASE])


def test_a_case_is_made_of_the_options_of_a_component() -> None:
    assert CASE.component is MlpFeedForward
    assert Case(Counts.Config()).component is Counts


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (ViewsConfig(), "ViewsConfig holds options of no component"),
        (MlpFeedForward, r"the class MlpFeedForward is no options; write Case\(MlpFeedForward.Con"),
        (MlpFeedForward.Config, r"is no options; write Case\(MlpFeedForward.Config\(\)\)"),
        (CASE.build(), r"an instance of MlpFeedForward is no options; write Case\(MlpFeedForward"),
        (Slotless.Config(), "can be made of Slotless, which implements no slot's contract"),
        (Nameless.Config(), "can be made of Nameless, which has no `name`"),
        (Centers.Config(), "can be made of Centers, which has no `name`"),
        (Formless.Config(), "can be made of Formless, which leaves forward abstract"),
    ],
)
def test_what_is_no_options_is_refused(given, message) -> None:
    with pytest.raises(TypeError, match=message):
        Case(given)


@pytest.mark.parametrize(
    ("tiers", "message"),
    [
        ("core", r'the text "core" and no list; write tiers=\["core"\]'),
        ("extended", r'the text "extended" and no list; write tiers=\["extended"\]'),
        ("cor", r'write tiers=\["core"\]'),
        ((), "with no tiers nothing is checked"),
        (None, "tiers is None and no list"),
        ([["core"]], r"there is no tier `\['core'\]`"),
        (["cor"], "there is no tier `cor`; did you mean `core`"),
        (["core", "all"], "there is no tier `all`; tiers: core, extended"),
    ],
)
def test_tiers_that_are_none_are_refused(tiers, message) -> None:
    for use in (
        lambda: parametrize_with_checks([CASE], tiers=tiers),
        lambda: checks_for(CASE, tiers),
        lambda: check_plugin("qgs", tiers),
    ):
        with pytest.raises(ValueError, match=message):
            use()
