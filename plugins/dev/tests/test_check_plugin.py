"""The contract suite on a plugin and on a case: reports, causes, exemptions, what is compared."""

from collections import deque
from importlib import import_module
from itertools import count
from pathlib import Path

import numpy
import pytest
import torch
from commands import done, run_qgs
from contract_mutants import modules
from contract_mutants.modules import CachesByShape, RaisesWhenBuilt
from qgs_dev import CHECKS, Case, CaseRun, checks_for, run_check, runs_of
from qgs_dev.vocabulary import attributes
from tables import must_refuse
from torch import nn

from qgs.contracts import CONTRACT_VERSION, MissingExtraError, Plugin
from qgs.data import PhotosSource
from qgs.recipe.registry import InstalledPlugin, PluginError
from qgs.renderers import GsplatRenderer, TorchRenderer
from qgs.tokengs import FreeCenters, GaussianHead, MlpFeedForward

UNBOUNDED = FreeCenters.Config(output_limit=None)
LARGE = "large_numbers_stay_finite"
GRADIENTS = "gradients_match_differences"
INPUTS = "gradients_reach_inputs"


class CannotDefault(MlpFeedForward):
    name = "cannot_default"

    class Config(MlpFeedForward.Config):
        def model_post_init(self, context) -> None:
            raise RuntimeError("no defaults today")


class NeedsMore(MlpFeedForward):
    name = "needs_more"

    def __init__(self, config, dims):
        raise MissingExtraError('needs_more needs numba: run `pip install "query-gaussians[cpu]"`')


class OnOtherDevices(TorchRenderer):
    name = "on_other_devices"
    devices = ("cuda",)


def _installed(*components, **parts) -> InstalledPlugin:
    return InstalledPlugin(Plugin("mine", CONTRACT_VERSION, components, **parts), "qgs-mine", "1.2")


def _report(monkeypatch, installed: InstalledPlugin, code: int = 1) -> str:
    for module in ("qgs.recipe.registry", "qgs_dev.running"):
        monkeypatch.setattr(f"{module}.load_plugin", lambda name: installed)
    result = run_qgs("check-plugin", "mine", "--core")
    assert result.exit_code == code, result.output
    return result.output


def test_the_report_has_a_cause_once(monkeypatch) -> None:
    output = _report(monkeypatch, _installed(MlpFeedForward, RaisesWhenBuilt))
    lines = output.splitlines()
    assert lines[0] == f"plugin mine of qgs-mine 1.2, contract version {CONTRACT_VERSION}"
    assert any(line.startswith("ok     feed_forward/mlp: ") for line in lines)
    assert any(line.startswith("FAILED feed_forward/raises_when_built: ") for line in lines)
    assert output.count("no kernel") == 1
    assert sum(line.startswith("  skipped: ") for line in lines) == 1
    assert ", 1 failed, 0 expected to fail, " in lines[-1]


def test_the_report_names_what_is_exempt(monkeypatch) -> None:
    exempt = {CachesByShape: {"forward_keeps_no_state": "it is a cache"}}
    output = _report(monkeypatch, _installed(CachesByShape, exemptions=exempt), code=0)
    assert "expected to fail: forward_keeps_no_state: it is a cache (seen: " in output
    assert "0 failed, 1 expected to fail, 0 skipped" in output


def test_exemptions_are_of_a_class_or_of_options() -> None:
    exempt = {FreeCenters: {GRADIENTS: "all"}, UNBOUNDED: {INPUTS: "these"}}
    installed = _installed(FreeCenters, examples=(UNBOUNDED,), exemptions=exempt)
    known = [(run.case.config, run.variant, run.expected) for run in runs_of(installed)]
    first = (FreeCenters.Config(), False, {GRADIENTS: "all"})
    assert known == [first, (UNBOUNDED, True, {GRADIENTS: "all", INPUTS: "these"})]


def test_unsound_exemptions_are_refused() -> None:
    for exemptions, examples in (
        ({FreeCenters: {"large_number_stay_finite": "why"}}, ()),
        ({FreeCenters: {"supervision_weights": "why"}}, ()),
        ({FreeCenters: {LARGE: ""}}, ()),
        ({GaussianHead: {LARGE: "why"}}, ()),
        ({UNBOUNDED: {INPUTS: "why"}}, ()),
        ({UNBOUNDED: {LARGE: "why"}}, (UNBOUNDED,)),  # made of the first case of a class alone
    ):
        installed = _installed(FreeCenters, examples=examples, exemptions=exemptions)
        must_refuse("exemptions", runs_of, installed, kind=PluginError)


def test_what_has_no_default_options_is_named(monkeypatch) -> None:
    for component in (CannotDefault, PhotosSource):
        output = _report(monkeypatch, _installed(component))
        assert f"not checked: {component.slot}/{component.name}: " in output


def test_what_cannot_be_built_here_is_not_checked(monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for component, why in (
        (NeedsMore, 'needs_more needs numba: run `pip install "query-gaussians[cpu]"`'),
        (OnOtherDevices, "runs only on cuda, which this machine does not have"),
    ):
        lines = _report(monkeypatch, _installed(FreeCenters, component)).splitlines()
        unchecked = [line.split(":")[0] for line in lines if line.startswith("not checked ")]
        assert unchecked == [f"not checked {component.slot}/{component.name}"]
        assert any(
            line.startswith("  skipped: ") and line.endswith(f"checks: {why}") for line in lines
        )
        assert lines[-1].endswith(", 1 not checked")


@pytest.mark.slow
def test_locus_passes() -> None:
    output = done("check-plugin", "locus").output
    assert "7 components" in output
    assert " 0 failed" in output


CASE = Case(MlpFeedForward.Config())
CACHES = Case(CachesByShape.Config())
FROZEN = "construction"


def test_an_error_is_reported_with_its_place_in_the_component() -> None:
    file = Path(modules.__file__)
    culprit = "raise RuntimeError"
    line = 1 + [culprit in text for text in file.read_text().splitlines()].index(True)
    result = run_check(CHECKS["builds"], Case(RaisesWhenBuilt.Config()))
    assert f" (raised under {file}:{line})\n" in result.message


def test_a_test_of_a_case_names_all_that_fails_and_skips_what_cannot_run(monkeypatch) -> None:
    run = CaseRun(CACHES, expected={FROZEN: "it might"})
    with pytest.raises(pytest.fail.Exception) as failure:
        run.check(["core", "construction"])
    titles = [line for line in str(failure.value).splitlines() if line.startswith(CACHES.label)]
    assert titles[0] == f"{CACHES.label}: forward_keeps_no_state"
    assert titles[1].startswith(f"{CACHES.label}: {FROZEN} passes, although")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    must_refuse(
        "runs only on cuda",
        CaseRun(Case(GsplatRenderer.Config())).check,
        ["core"],
        kind=pytest.skip.Exception,
    )


def test_further_options_of_a_class_have_the_checks_that_see_options() -> None:
    variant = {check.name for check in checks_for(CASE, variant=True)}
    assert {"builds", "runs", "gradients_match_differences"} <= variant
    assert variant < {check.name for check in checks_for(CASE)}


def test_every_check_is_in_the_table() -> None:
    modules = {import_module(check.function.__module__) for check in CHECKS.values()}
    written = {name for module in modules for name in vars(module) if name.startswith("check_")}
    assert written == {f"check_{name}" for name in CHECKS}


class Keeper(nn.Module):
    def __init__(self, kept: object) -> None:
        super().__init__()
        self.part = nn.Linear(2, 2)
        vars(self.part)["_kept"] = kept


KEPT = {
    "a list that grows": ([], lambda kept: kept.append(0)),
    "a queue of constant length": (deque([1, 2], maxlen=2), lambda kept: kept.append(3)),
    "a tensor": (torch.zeros(1000), lambda kept: kept[500:501].add_(1)),
    "an array": (numpy.zeros(1000), lambda kept: kept.__setitem__(500, 1)),
    "an iterator": (count(), next),
}


def test_a_change_is_seen() -> None:
    for what, (kept, change) in KEPT.items():
        module = Keeper(kept)
        before = attributes(module)
        assert attributes(module) == before
        change(kept)
        after = attributes(module).items()
        assert [name for name, value in after if before.get(name) != value], what


def test_what_contains_itself_comes_to_an_end() -> None:
    circle: list[object] = []
    circle.append(circle)
    assert attributes(Keeper(circle))["part._kept"] == [None]
