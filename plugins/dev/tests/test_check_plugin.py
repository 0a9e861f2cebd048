"""The contract suite on a plugin and on a case: reports, causes, exemptions, what is compared."""

from collections import deque
from fnmatch import fnmatchcase
from importlib import import_module
from itertools import count
from unittest.mock import Mock

import numpy
import pytest
import torch
from commands import done, run_qgs
from contract_mutants import modules
from contract_mutants.modules import CachesByShape, RaisesWhenBuilt
from qgs_dev import CHECKS, Case, CaseRun, checks_for, runs_of
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
        def model_post_init(self, context):
            raise RuntimeError("no defaults today")


class NeedsMore(MlpFeedForward):
    name = "needs_more"

    def __init__(self, config, dims):
        raise MissingExtraError('needs_more needs numba: run `pip install "query-gaussians[cpu]"`')


class OnOtherDevices(TorchRenderer):
    name = "on_other_devices"
    devices = ("cuda",)


def _installed(*components, **parts):
    return InstalledPlugin(Plugin("mine", CONTRACT_VERSION, components, **parts), "qgs-mine", "1.2")


CULPRIT = RaisesWhenBuilt.add.__code__.co_firstlineno + 1
REPORTS = (
    (
        _installed(MlpFeedForward, RaisesWhenBuilt),
        f"""
ok     feed_forward/mlp: * of * pass
FAILED feed_forward/raises_when_built: 0 of * pass
  feed_forward/raises_when_built: builds
    seen: RuntimeError: no kernel for width 32 (raised under {modules.__file__}:{CULPRIT})
    contract: *
  skipped: * checks: `builds` fails: see that check
2 components, * checks, 1 failed, 0 expected to fail, * skipped, 1 not checked
exit code 1""",
    ),
    (
        _installed(
            CachesByShape, exemptions={CachesByShape: {"forward_keeps_no_state": "a cache"}}
        ),
        """
ok     feed_forward/caches_by_shape: * of * pass
  expected to fail: forward_keeps_no_state: a cache (seen: *
1 component, * checks, 0 failed, 1 expected to fail, 0 skipped, 0 not checked
exit code 0""",
    ),
    (
        _installed(CannotDefault, PhotosSource),
        """
not checked: feed_forward/cannot_default: *
not checked: data/photos: *
0 components, 0 checks, 0 failed, 0 expected to fail, 0 skipped, 0 not checked
exit code 1""",
    ),
    (
        _installed(FreeCenters, NeedsMore, OnOtherDevices),
        """
ok     centers/free: * of * pass
not checked feed_forward/needs_more: * of * pass
  skipped: * checks: needs_more needs numba: run `pip install "query-gaussians?cpu?"`
not checked renderer/on_other_devices: * of * pass
  skipped: * checks: runs only on cuda, which this machine does not have
3 components, * checks, 0 failed, 0 expected to fail, * skipped, 2 not checked
exit code 1""",
    ),
)
"""What is told of plugins after the first line, and the exit code; any text for a star."""


def test_reports(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for installed, told in REPORTS:
        for module in ("qgs.recipe.registry", "qgs_dev.running"):
            monkeypatch.setattr(f"{module}.load_plugin", Mock(return_value=installed))
        result = run_qgs("check-plugin mine --core")
        head = f"plugin mine of qgs-mine 1.2, contract version {CONTRACT_VERSION}"
        lines = f"{result.output}exit code {result.exit_code}".splitlines()
        assert [*map(fnmatchcase, lines, (head + told).splitlines())] == [True] * len(lines), lines


def test_exemptions_are_of_a_class_or_of_options():
    exempt = {FreeCenters: {GRADIENTS: "all"}, UNBOUNDED: {INPUTS: "these"}}
    installed = _installed(FreeCenters, examples=(UNBOUNDED,), exemptions=exempt)
    known = [(run.case.config, run.variant, run.expected) for run in runs_of(installed)]
    first = (FreeCenters.Config(), False, {GRADIENTS: "all"})
    assert known == [first, (UNBOUNDED, True, {GRADIENTS: "all", INPUTS: "these"})]


def test_unsound_exemptions_are_refused():
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


@pytest.mark.slow
def test_locus_passes():
    output = done("check-plugin locus").output
    assert "7 components" in output
    assert " 0 failed" in output


CASE = Case(MlpFeedForward.Config())


def test_a_test_of_a_case_names_all_that_fails_and_skips_what_cannot_run(monkeypatch):
    run = CaseRun(Case(CachesByShape.Config()), expected={"construction": "it might"})
    told = (
        rf"^{run}: forward_keeps_no_state\n  seen: .*\n  contract: .*\n\n"
        rf"{run}: construction passes, although"
    )
    must_refuse(told, run.check, ["core", "construction"], kind=pytest.fail.Exception)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    must_refuse(
        "runs only on cuda",
        CaseRun(Case(GsplatRenderer.Config())).check,
        ["core"],
        kind=pytest.skip.Exception,
    )


def test_further_options_of_a_class_have_the_checks_that_see_options():
    variant = {check.name for check in checks_for(CASE, variant=True)}
    assert {"builds", "runs", "gradients_match_differences"} <= variant
    assert variant < {check.name for check in checks_for(CASE)}


def test_every_check_is_in_the_table():
    modules = {import_module(check.function.__module__) for check in CHECKS.values()}
    written = {name for module in modules for name in vars(module) if name.startswith("check_")}
    assert written == {f"check_{name}" for name in CHECKS}


class Keeper(nn.Module):
    def __init__(self, kept):
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


def test_a_change_is_seen():
    for what, (kept, change) in KEPT.items():
        module = Keeper(kept)
        before = attributes(module)
        assert attributes(module) == before
        change(kept)
        after = attributes(module).items()
        assert [name for name, value in after if before.get(name) != value], what


def test_what_contains_itself_comes_to_an_end():
    circle = []
    circle.append(circle)
    assert attributes(Keeper(circle))["part._kept"] == [None]
