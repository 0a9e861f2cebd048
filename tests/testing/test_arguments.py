"""Cases and tiers that are none are refused with what to write."""

from __future__ import annotations

import sys

import pytest
from contract_mutants.halves import TurnsInFull
from contract_mutants.inner_options import LosesAnOption
from contract_mutants.modules import Counts

from qgs.components import MlpFeedForward
from qgs.composer.registry import BUILTIN
from qgs.contracts import Centers, Component, ModelDims, ViewsConfig
from qgs.contracts.component import MissingExtraError
from qgs.testing import (
    CHECKS,
    Case,
    cases_of,
    check_plugin,
    checks_for,
    parametrize_with_checks,
    run_check,
)

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


SHAPES = CASE.build().state_dict()


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"dims": (32, 2, 2)}, TypeError, r"dims is \(32, 2, 2\); write dims=ModelDims\(width"),
        ({"dims": ModelDims(33, 2, 2)}, ValueError, "a width that its heads divide"),
        ({"dims": ModelDims(32, 0, 2)}, ValueError, "a width that its heads divide"),
        ({"image_size": 64}, TypeError, r"image_size is 64; write \(H, W\) in pixels"),
        ({"image_size": [16, 24]}, TypeError, r"image_size is \[16, 24\]; write \(H, W\)"),
        ({"image_size": (16, 0)}, TypeError, r"write \(H, W\) in pixels"),
        ({"state_dict": ["norm.weight"]}, TypeError, "write {name: shape}"),
        ({"state_dict": {"norm.weight": 32}}, TypeError, r"'norm.weight'\] is 32; write"),
        ({"state_dict": SHAPES}, TypeError, r"write {name: tuple\(x.shape\) for name, x in mod"),
        ({"fields": ["place.center"]}, TypeError, r"fields is \['place.center'\]; write"),
        ({"fields": {"place.center": 3}}, TypeError, "write a function that makes a valid"),
        ({"fields": {"place.centre": abs}}, ValueError, "did you mean `place.center`"),
    ],
)
def test_what_no_case_can_have_is_refused(given, error, message) -> None:
    with pytest.raises(error, match=message):
        Case(TurnsInFull.Config() if "fields" in given else MlpFeedForward.Config(), **given)


def test_what_a_case_can_have_is_taken() -> None:
    shapes = {name: list(x.shape) for name, x in SHAPES.items()}
    sized = Case(MlpFeedForward.Config(), image_size=(16, 24), state_dict=shapes)
    assert run_check(CHECKS["state_dict_keys"], sized).verdict == "passed"
    assert Case(TurnsInFull.Config(), fields={"place.center": abs}).fields


def test_a_case_is_named_by_options_that_yaml_does_not_get() -> None:
    assert Case(LosesAnOption.Config(shift=0.5)).label == "centers/loses_an_option(shift: 0.5)"


@pytest.mark.parametrize(
    ("use", "error", "message"),
    [
        (lambda: run_check("runs", CASE), TypeError, r'no check; give CHECKS\["runs"\]'),
        (lambda: run_check("rans", CASE), KeyError, "no check `rans`; did you mean `runs`"),
        (lambda: run_check(CASE, CHECKS["runs"]), TypeError, "is no check; give CHECKS"),
        (
            lambda: run_check(CHECKS["runs"], MlpFeedForward.Config()),
            TypeError,
            r"no case; give Case\(MlpFeedForward",
        ),
        (
            lambda: run_check(CHECKS["head_gives_gaussians"], CASE),
            ValueError,
            "applies to head, and feed_forward/mlp is none of them",
        ),
        (lambda: CHECKS["config_is_frosen"], KeyError, "did you mean `config_is_frozen`"),
        (lambda: checks_for(MlpFeedForward), TypeError, r"no case; give Case\(MlpFeedForward"),
        (lambda: cases_of("qgs"), TypeError, r"cases_of\(qgs.composer.registry.load_plugin\('qgs"),
        (lambda: cases_of(BUILTIN), TypeError, r"registry.not_installed\(plugin\)"),
        (lambda: check_plugin(MlpFeedForward), TypeError, "is no name of a plugin"),
        (
            lambda: parametrize_with_checks([CASE], contract_version="1"),
            TypeError,
            "contract_version is '1'; write it as a number, such as contract_version=1",
        ),
    ],
)
def test_what_no_check_takes_is_refused(use, error, message) -> None:
    with pytest.raises(error, match=message):
        use()


def test_pytest_is_asked_for(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pytest", None)
    refusal = None
    try:
        parametrize_with_checks([CASE])
    except MissingExtraError as error:
        refusal = error
    assert "needs pytest, which is not installed: run `pip install pytest`" in str(refusal)


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
