"""Plugins that are broken, and components that cannot stand together."""

import sys
from pathlib import Path

import pytest
from refusals import refused
from typer.testing import CliRunner

from qgs.cli import app
from qgs.composer.recipe import resolve
from qgs.composer.registry import available_plugins, load_sound_plugins

CHAIN = """
from qgs.contracts import CrossAttention, FieldSpec, Plugin, LearnedQueries, Refinement

class Start(LearnedQueries):
    name = "start"
    count = 3
    @classmethod
    def fields_written(cls, config):
        return {"place": FieldSpec((3,))}
    def start(self, batch_size):
        raise NotImplementedError

class Reader(CrossAttention):
    name = "reader"
    fields_read = Start.fields_written
    def forward(self, state, memory):
        return state.features

class Refine(Refinement):
    name = "refine"
    fields_read = fields_written = Start.fields_written
    def forward(self, state):
        return state

class Late(Refinement):
    name = "late"
    fields_written = Start.fields_written
    def forward(self, state):
        return state

plugin = Plugin("chain", 1, (Reader, Refine, Late, Start))
"""


@pytest.mark.parametrize(
    ("decoder", "too_late"),
    [
        ("{cross_attention: {type: chain/reader}}", False),
        ("{refinement: {type: chain/refine}}", False),
        ("{cross_attention: {type: chain/reader}, refinement: {type: chain/late}}", True),
    ],
)
def test_what_reads_a_field_is_no_provider_of_it(decoder, too_late, write, install):
    install("qgs-chain", "chain", CHAIN)
    problem = refused(write(f"recipe: 1\nplugins: [chain]\nmodel: {{decoder: {decoder}}}\n"))
    assert "needs place" in problem.reason
    assert ("too late" in problem.reason) is too_late
    assert problem.fix.startswith("use `chain/start` in the slot `queries`")


IMPORTS = """
from collections.abc import Callable
from qgs.components import LatentQueries
from qgs.contracts import Centers, ComponentConfig, Plugin, LearnedQueries
from qgs.metrics.images import Psnr
from qgs.renderers import TorchRenderer
"""
BROKEN_PLUGINS = {
    "raises at import": ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
    "is no Plugin": (
        "plugin = {}",
        "is no qgs.Plugin: its entry point leads to an object of type dict",
    ),
    "no object at its entry point": ("other = 1", "has no attribute 'plugin'"),
    "unlisted component": (
        "plugin = Plugin('bad', 1, LatentQueries)",
        "must give `components` as a tuple or a list, written `(Mine,)` for a single one",
    ),
    "nameless component": (
        "class Nameless(LatentQueries):\n    name = ''\nplugin = Plugin('bad', 1, (Nameless,))",
        "whose name '' is empty or has a slash or a blank",
    ),
    "option that no recipe can give": (
        "class Odd(Centers):\n    name = 'odd'\n"
        "    class Config(ComponentConfig):\n        function: Callable = print\n"
        "    def forward(self, offsets, state):\n        return offsets\n"
        "plugin = Plugin('bad', 1, (Odd,))",
        "lists Odd, whose Config has options that YAML cannot express",
    ),
    "options that can be changed": (
        "class Soft(LatentQueries):\n    name = 'soft'\n"
        "    class Config(LatentQueries.Config):\n        model_config = {'frozen': False}\n"
        "plugin = Plugin('bad', 1, (Soft,))",
        "lists Soft, whose Config is not frozen; leave `frozen` of its `model_config` at True",
    ),
    "metric that does not say what it measures": (
        "class Mute(Psnr):\n    name = 'mute'\n    definition = ''\n"
        "plugin = Plugin('bad', 1, (Mute,))",
        "lists Mute, which gives no `definition`; say in words what it measures, since protocols "
        "hash it",
    ),
    "wrong contract version": ("plugin = Plugin('bad', 0, ())", "contract version 0"),
    "contract version that is a text": (
        "plugin = Plugin('bad', '1', ())",
        "must give `contract_version` as a whole number, not '1'",
    ),
    "contract version that is a truth": (
        "plugin = Plugin('bad', True, ())",
        "must give `contract_version` as a whole number, not True",
    ),
    "nothing in it": (
        "plugin = Plugin('bad', 1, ())",
        "is empty: it lists no `components`, `layouts` or `models`",
    ),
    "other name": ("plugin = Plugin('qgs', 1, ())", "calls itself `qgs`"),
    "taken component name": (
        "plugin = Plugin('bad', 1, (LatentQueries, LatentQueries))",
        "registers `latent` twice",
    ),
    "abstract component": (
        "class Half(LearnedQueries):\n    name = 'half'\nplugin = Plugin('bad', 1, (Half,))",
        "leaves start abstract",
    ),
    "device that is none": (
        "class Odd(TorchRenderer):\n    name = 'odd'\n    devices = ('tpu',)\n"
        "plugin = Plugin('bad', 1, (Odd,))",
        "lists Odd, whose `devices` is ('tpu',); give some of ('cpu', 'cuda', 'mps') as a tuple",
    ),
    "no component": ("plugin = Plugin('bad', 1, (int,))", "is no qgs component"),
    "no layout": (
        "plugin = Plugin('bad', 1, (), layouts=(int,))",
        "lists <class 'int'>, which is no WeightLayout",
    ),
}


@pytest.mark.parametrize("name", BROKEN_PLUGINS)
def test_broken_plugin_is_reported_by_distribution(name, write, install):
    source, reason = BROKEN_PLUGINS[name]
    install("qgs-bad", "bad", IMPORTS + source, version="0.7")
    problem = refused(write("recipe: 1\nplugins: [bad]\nmodel: {queries: {type: bad/any}}\n"))
    assert (problem.file, problem.line, problem.option) == ("recipe.yaml", 2, "plugins.0")
    assert "qgs-bad 0.7" in problem.reason
    assert reason in problem.reason
    assert "qgs-bad 0.7" in problem.fix
    resolve(write("recipe: 1\n", "other.yaml"))


def test_a_plugin_may_offer_layouts_alone(write, install):
    source = """
    from qgs.components import TOKENGS
    from qgs.contracts import Plugin
    plugin = Plugin("layouts", 1, (), layouts=(TOKENGS,))
    """
    install("qgs-layouts", "layouts", source)
    assert resolve(write("recipe: 1\nplugins: [layouts]\n")).plugin_versions["layouts"] == "1.2"


@pytest.mark.parametrize(
    ("source", "fix"),
    [
        ("import a_package_that_nobody_has.inside", "install `a_package_that_nobody_has`, which"),
        ("import _test_qgs_odd.gone", "update qgs-odd 1.2, or do without the plugin"),
        ("import qgs.gone", "update qgs-odd 1.2, or do without the plugin"),
        ("", "install qgs-odd 1.2 again, its files are gone"),
        (f"{IMPORTS}plugin = Plugin('odd', 99, ())", "update qgs, or do without the plugin"),
    ],
)
def test_fix_of_a_plugin_that_cannot_be_imported(source, fix, write, install):
    install("qgs-odd", "odd", source)
    if not source:
        Path(sys.path[0], "_test_qgs_odd.py").unlink()
    problem = refused(write("recipe: 1\nplugins: [odd]\n"))
    assert problem.fix.startswith(fix)


def test_two_distributions_with_one_plugin_name(write, install):
    source = "from qgs.contracts import Plugin\nplugin = Plugin('twin', 1, ())"
    install("first-twin", "twin", source)
    install("second-twin", "twin", source)
    problem = refused(write("recipe: 1\nplugins: [twin]\n"))
    assert "first-twin 1.2, second-twin 1.2" in problem.reason
    assert "uninstall" in problem.fix


def test_a_distribution_that_takes_the_frameworks_name_is_reported(write, install):
    install("impostor", "qgs", "from qgs.contracts import Plugin\nplugin = Plugin('qgs', 1, ())")
    registry, broken = load_sound_plugins()
    (message,) = [message for message in broken if "impostor 1.2" in message]
    assert "`qgs`, the framework's own name" in message
    assert "qgs/latent" in registry.components("queries")
    resolve(write("recipe: 1\n"))


def test_one_fault_of_a_plugin_does_not_hide_the_others_of_an_installation(install):
    install("qgs-raises", "raises", "raise RuntimeError('no luck')")
    install(
        "qgs-moody",
        "moody",
        """
        from pydantic import field_validator
        from qgs.contracts import Centers, ComponentConfig, Plugin
        class Moody(Centers):
            name = "moody"
            class Config(ComponentConfig):
                mood: int = 1
                @field_validator("mood")
                @classmethod
                def _refuse(cls, mood):
                    raise ValueError("no mood will do")
                model_config = {"validate_default": True}
            def forward(self, offsets, state):
                return offsets
        plugin = Plugin("moody", 1, (Moody,))
        """,
    )
    result = CliRunner().invoke(app, ["list"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    assert "moody/moody" in result.output
    assert "qgs-raises 1.2 cannot be imported" in result.output
    assert "qgs/latent" in result.output
    assert CliRunner().invoke(app, ["schema"]).exit_code == 0


def test_a_plugin_that_comes_to_a_folder_or_leaves_it_is_noticed(tmp_path, monkeypatch):
    """Though what is installed is read once for as long as nothing changes."""
    monkeypatch.syspath_prepend(tmp_path)
    assert "late" not in available_plugins()
    info = tmp_path / "late-1.0.dist-info"
    info.mkdir()
    (info / "entry_points.txt").write_text("[qgs.plugins]\nlate = late:plugin\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    assert "late" in available_plugins()
    info.rename(tmp_path / "gone")
    assert "late" not in available_plugins()
