"""The contract suite on a whole plugin: its report, its examples, its exemptions."""

import pytest
import torch
from commands import run_qgs
from contract_mutants.basics import RaisesWhenCalled
from contract_mutants.state import CountsItsCalls
from pydantic import Field
from qgs_plugintools import Case, cases_of, check_plugin
from qgs_plugintools.exercise import idle_options
from qgs_plugintools.plugins import exemptions_of

from qgs.components import (
    ContentCrossAttention,
    FreeCenters,
    GaussianHead,
    LatentQueries,
    MlpFeedForward,
    OneCycleAdamW,
)
from qgs.composer.registry import InstalledPlugin, PluginError
from qgs.contracts import CONTRACT_VERSION, MissingExtraError, Plugin, ViewsConfig
from qgs.data import ChunksSource
from qgs.geometry.precision import at_least_float32
from qgs.losses import Opacity
from qgs.renderers import TorchRenderer

UNBOUNDED = FreeCenters.Config(output_limit=None)
LARGE = "large_numbers_stay_finite"


class CannotDefault(MlpFeedForward):
    name = "cannot_default"

    class Config(MlpFeedForward.Config):
        def model_post_init(self, context) -> None:
            raise RuntimeError("no defaults today")


class CannotJudge(MlpFeedForward):
    name = "cannot_judge"

    @classmethod
    def problems(cls, config, context):
        raise RuntimeError("no judgement today")


class LeavesInForward(MlpFeedForward):
    name = "leaves_in_forward"

    def forward(self, features):
        raise SystemExit(0)


class LeavesWhenJudged(MlpFeedForward):
    name = "leaves_when_judged"

    @classmethod
    def problems(cls, config, context):
        raise SystemExit(0)


class NeedsMore(MlpFeedForward):
    name = "needs_more"

    def __init__(self, config, dims):
        raise MissingExtraError('needs_more needs numba: run `pip install "query-gaussians[cpu]"`')


class OnOtherDevices(TorchRenderer):
    name = "on_other_devices"
    devices = ("cuda",)


class ReadsTheTop(ContentCrossAttention):
    """Each head of each query reads `top` tokens; the suite's memory has 12."""

    name = "reads_the_top"

    class Config(ContentCrossAttention.Config):
        top: int = Field(default=32, ge=1)
        careful: bool = False

    def bias(self, state, memory):
        logits = self.core.project(state.features) @ memory.keys.mT
        least = logits.topk(min(self.config.top, logits.shape[-1])).values[..., -1:]
        return at_least_float32(torch.zeros_like(logits)).masked_fill(logits < least, -torch.inf)

    def forward(self, state, memory):
        return self.core(state.features, memory.keys, memory.values, self.bias(state, memory))

    def explain(self, state, memory, queries):
        bias = self.bias(state, memory)
        return self.core.explain(state.features, memory.keys, queries, bias)


class ReadsNoMore(ReadsTheTop):
    """Options of all kinds that nothing reads."""

    name = "reads_no_more"

    class Config(ReadsTheTop.Config):
        dropout: float = 0.0
        words: str = "none"
        none: int | None = None


def _installed(*components, **parts) -> InstalledPlugin:
    return InstalledPlugin(Plugin("mine", CONTRACT_VERSION, components, **parts), "qgs-mine", "1.2")


def _report(monkeypatch, installed: InstalledPlugin, *options: str):
    for module in ("qgs_plugintools.check_command", "qgs_plugintools.plugins"):
        monkeypatch.setattr(f"{module}.load_plugin", lambda name: installed)
    return run_qgs("check-plugin", "mine", *options)


def test_an_unknown_plugin_is_told() -> None:
    result = run_qgs("check-plugin", "lucos")
    assert "no installed distribution offers a plugin `lucos`" in str(result.exception)


def test_the_report_tells_a_cause_once(monkeypatch) -> None:
    result = _report(monkeypatch, _installed(MlpFeedForward, RaisesWhenCalled), "--core")
    assert result.exit_code == 1
    lines = result.output.splitlines()
    assert lines[0] == f"plugin mine of qgs-mine 1.2, contract version {CONTRACT_VERSION}"
    assert any(line.startswith("ok     feed_forward/mlp: ") for line in lines)
    assert any(line.startswith("FAILED feed_forward/raises_when_called: ") for line in lines)
    assert result.output.count("mat1 and mat2") == 1
    skips = [line for line in lines if line.startswith("  skipped: ")]
    assert len(skips) == 1
    assert "checks: ends with an error as `runs` does: see that check" in skips[0]
    assert lines[-1].startswith("2 components, ")
    assert ", 1 failed, 0 expected to fail, " in lines[-1]


def test_options_that_no_check_exercised_are_noted(monkeypatch) -> None:
    idle = {"careful": ["true"], "top": ["31", "33", "64"]}
    large, small = (Case(ReadsTheTop.Config(top=top)) for top in (32, 8))
    assert idle_options([large]) == idle
    assert idle_options([small]) == idle_options([large, small]) == {"careful": ["true"]}
    assert idle_options([small, Case(ReadsTheTop.Config(top=8, norm_eps=0.1))]).keys() == {
        "careful"
    }
    more = idle_options([Case(ReadsNoMore.Config())])
    assert more == idle | {"dropout": ["0.5", "1.0"], "words": [], "none": []}
    result = _report(monkeypatch, _installed(ReadsTheTop, ReadsNoMore), "--core")
    assert result.exit_code == 0, result.output
    untried = "note: cross_attention/reads_no_more: no other values were tried of words, none\n"
    assert untried in result.output
    assert "reads_the_top: no other values" not in result.output
    note = "note: cross_attention/reads_the_top: no value of `top` that was tried (31, 33, 64) "
    assert f"{note}changed anything, so no check exercised it; " in result.output
    assert "`norm_eps`" not in result.output


@pytest.mark.parametrize(
    ("component", "idle"),
    [
        (OneCycleAdamW, set()),
        (LatentQueries, set()),
        (Opacity, set()),
        (TorchRenderer, {"near", "far", "transmittance_min", "background"}),
    ],
)
def test_components_of_every_kind_of_slot_are_exercised(component, idle) -> None:
    assert idle_options([Case(component.Config())]).keys() == idle


def test_the_report_names_what_is_exempt(monkeypatch) -> None:
    exempt = {CountsItsCalls: {"forward_keeps_no_state": "it is a counter"}}
    result = _report(monkeypatch, _installed(CountsItsCalls, exemptions=exempt), "--core")
    assert result.exit_code == 0, result.output
    assert "expected to fail: forward_keeps_no_state: it is a counter (seen: " in result.output
    assert "0 failed, 1 expected to fail, 0 skipped" in result.output


def test_exemptions_are_of_a_class_or_of_options() -> None:
    exempt = {FreeCenters: {"config_round_trip": "all"}, UNBOUNDED: {LARGE: "these"}}
    installed = _installed(FreeCenters, examples=(UNBOUNDED,), exemptions=exempt)
    cases = cases_of(installed)
    assert [case.config for case in cases] == [FreeCenters.Config(), UNBOUNDED]
    known = exemptions_of(installed, cases)
    assert known == [{"config_round_trip": "all"}, {"config_round_trip": "all", LARGE: "these"}]


@pytest.mark.parametrize(
    ("exemptions", "message"),
    [
        ({FreeCenters: {"large_number_stay_finite": "why"}}, f"did you mean `{LARGE}`"),
        ({FreeCenters: {"supervision_weights": "why"}}, "but to supervision"),
        ({FreeCenters: {LARGE: ""}}, f"`{LARGE}` needs a reason"),
        ({FreeCenters: LARGE}, "those of .*FreeCenters"),
        ({GaussianHead: {LARGE: "why"}}, "GaussianHead.* is neither a component of the plugin nor"),
        ({UNBOUNDED: {LARGE: "why"}}, "nor the options of a case"),
    ],
)
def test_unsound_exemptions_are_told_by_distribution(monkeypatch, exemptions, message) -> None:
    installed = _installed(FreeCenters, exemptions=exemptions)
    with pytest.raises(PluginError, match=message) as refusal:
        exemptions_of(installed, cases_of(installed))
    assert "the `exemptions` of the plugin `mine` of qgs-mine 1.2: " in str(refusal.value)
    monkeypatch.setattr("qgs_plugintools.plugins.load_plugin", lambda name: installed)
    with pytest.raises(PluginError, match=message):
        check_plugin("mine")


@pytest.mark.parametrize(
    ("example", "message"),
    [
        (FreeCenters, r"FreeCenters'> is not options of its components, such as MyComponent"),
        ({"z_offset": 1.0}, "is not options of its components"),
        (ViewsConfig(), "is not options of its components"),
        (GaussianHead.Config(), "is not options of its components"),
    ],
)
def test_unsound_examples_are_told_by_distribution(example, message) -> None:
    with pytest.raises(PluginError, match=message) as refusal:
        cases_of(_installed(FreeCenters, examples=(example,)))
    assert "the `examples` of the plugin `mine` of qgs-mine 1.2: " in str(refusal.value)


@pytest.mark.parametrize(
    ("component", "why"),
    [
        (CannotDefault, "its default options are refused: RuntimeError: no defaults today"),
        (ChunksSource, "there is no default for `path`"),
    ],
)
def test_what_has_no_default_options_is_named(monkeypatch, component, why) -> None:
    result = _report(monkeypatch, _installed(component), "--core")
    assert result.exit_code == 1
    assert f"not checked: {component.slot}/{component.name}: {why}" in result.output
    assert "list a Config of it in `examples` of the Plugin" in result.output


def test_problems_that_raise_are_found_by_the_checks(monkeypatch) -> None:
    result = _report(monkeypatch, _installed(CannotJudge), "--core")
    assert result.exit_code == 1
    assert "no judgement today" in result.output
    assert result.output.splitlines()[-1].startswith("1 component, ")


@pytest.mark.parametrize("component", [LeavesInForward, LeavesWhenJudged])
def test_a_component_that_leaves_the_process_fails(monkeypatch, component) -> None:
    result = _report(monkeypatch, _installed(component, FreeCenters), "--core")
    assert result.exit_code == 1
    lines = result.output.splitlines()
    assert any(line.startswith(f"FAILED feed_forward/{component.name}: ") for line in lines)
    assert any(line.startswith("ok     centers/free: ") for line in lines)
    assert "seen: SystemExit: 0 (raised under " in result.output
    assert lines[-1].startswith("2 components, ")


@pytest.mark.parametrize(
    ("component", "why"),
    [
        (NeedsMore, 'needs_more needs numba: run `pip install "query-gaussians[cpu]"`'),
        (OnOtherDevices, "runs on cuda alone, which is not here"),
    ],
)
def test_what_cannot_be_built_here_is_not_checked(monkeypatch, component, why) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    result = _report(monkeypatch, _installed(FreeCenters, component), "--core")
    assert result.exit_code == 1
    lines = result.output.splitlines()
    unchecked = [line for line in lines if line.startswith("not checked ")]
    assert [line.split(":")[0] for line in unchecked] == [
        f"not checked {component.slot}/{component.name}"
    ]
    assert any(line.startswith("  skipped: ") and line.endswith(f"checks: {why}") for line in lines)
    assert lines[-1].endswith(", 1 not checked")


@pytest.mark.slow
def test_locus_passes() -> None:
    result = run_qgs("check-plugin", "locus")
    assert result.exit_code == 0, result.output
    assert "7 components" in result.output
    assert " 0 failed" in result.output
