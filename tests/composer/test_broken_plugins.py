"""Plugins that cannot be used and components that fail: the distribution is named."""

import sys
import traceback
from pathlib import Path

import pytest
from refusals import refused
from typer.testing import CliRunner

from qgs.cli import app
from qgs.composer import RecipeError, compose, resolve
from qgs.composer.registry import available_plugins, load_usable_plugins
from qgs.contracts import CONTRACT_VERSION, LearnedQueries, Plugin

IMPORTS = """
from qgs.components import LatentQueries
from qgs.contracts import CONTRACT_VERSION, Plugin, WeightLayout
"""
BROKEN = {
    "raises at import": ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
    "syntax": ("def f(:", "SyntaxError"),
    "exits at import": ("raise SystemExit(3)", "SystemExit: 3"),
    "is no Plugin": ("plugin = {}", "qgs.Plugin"),
    "no object at its entry point": ("other = 1", "'plugin'"),
    "older contracts": ("plugin = Plugin('bad', 0, ())", "version 0"),
    "other name": ("plugin = Plugin('qgs', CONTRACT_VERSION, ())", "`qgs`"),
    "no component": ("plugin = Plugin('bad', CONTRACT_VERSION, (int,))", "int"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_plugin_is_reported_by_distribution(name, write, install):
    source, word = BROKEN[name]
    install("qgs-bad", "bad", IMPORTS + source, version="0.7")
    problem = refused(write("recipe: 1\nplugins: [bad]\nmodel: {queries: {type: bad/any}}\n"))
    assert (problem.file, problem.line, problem.option) == ("recipe.yaml", 2, "plugins.0")
    assert "qgs-bad 0.7" in problem.reason
    assert word in problem.reason
    assert "qgs-bad 0.7" in problem.fix
    resolve(write("recipe: 1\n", "other.yaml"))


@pytest.mark.parametrize(
    ("source", "fix"),
    [
        ("import a_package_that_nobody_has.inside", "install `a_package_that_nobody_has`"),
        ("import _test_qgs_odd.gone", "update or correct qgs-odd 1.2"),
        ("import qgs.gone", "update or correct qgs-odd 1.2"),
        ("", "install qgs-odd 1.2 again"),
    ],
)
def test_fix_of_a_plugin_that_cannot_be_imported(source, fix, write, install):
    install("qgs-odd", "odd", source)
    if not source:
        Path(sys.path[0], "_test_qgs_odd.py").unlink()
    assert refused(write("recipe: 1\nplugins: [odd]\n")).fix.startswith(fix)


def test_a_plugin_may_offer_layouts_alone(write, install):
    layout = "WeightLayout('', '', {}, (), ('mark',), dict)"
    listed = f"plugin = Plugin('layouts', CONTRACT_VERSION, (), layouts=({layout},))"
    install("qgs-layouts", "layouts", IMPORTS + listed)
    assert resolve(write("recipe: 1\nplugins: [layouts]\n")).releases["layouts"][1] == "1.2"


def test_two_distributions_with_one_plugin_name(write, install):
    for name in ("first-twin", "second-twin"):
        install(name, "twin", f"{IMPORTS}plugin = Plugin('twin', CONTRACT_VERSION, ())")
    problem = refused(write("recipe: 1\nplugins: [twin]\n"))
    assert "first-twin 1.2, second-twin 1.2" in problem.reason


def test_broken_plugins_and_impostors_hide_no_other_plugin(write, install):
    install("impostor", "qgs", f"{IMPORTS}plugin = Plugin('qgs', CONTRACT_VERSION, ())")
    install("qgs-raises", "raises", "raise RuntimeError('no luck')")
    registry, broken = load_usable_plugins()
    assert sum("impostor 1.2" in message or "qgs-raises 1.2" in message for message in broken) == 2
    assert "qgs/latent" in registry.components("queries")
    resolve(write("recipe: 1\n"))
    result = CliRunner().invoke(app, ["list"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    assert "qgs-raises 1.2" in result.output
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


FAULTY = """
from pydantic import field_validator
from qgs.contracts import CONTRACT_VERSION, ComponentConfig, Loss, Plugin, Refinement, SceneSource

class Faulty(Refinement):
    name = "faulty"
    class Config(ComponentConfig):
        at: str = "nowhere"
        @field_validator("at")
        @classmethod
        def _check(cls, at):
            return {}["x"] if at == "Config" else at
    def __init__(self, config, dims):
        super().__init__(config, dims)
        {}["x"] if config.at == "__init__" else None
    @classmethod
    def fields_read(cls, config):
        return {}["x"] if config.at == "fields_read" else {}
    @classmethod
    def fields_written(cls, config):
        return {}["x"] if config.at == "fields_written" else {}
    @classmethod
    def problems(cls, config, context):
        return {}["x"] if config.at == "problems" else ()
    def forward(self, state):
        return state

class Closed(SceneSource):
    name = "closed"
    def __init__(self, config):
        raise FileNotFoundError("photos/ is not there")
    def scenes(self, split):
        raise NotImplementedError

class AbstractLoss(Loss):
    name = "abstract"

plugin = Plugin("faulty", CONTRACT_VERSION, (Faulty, Closed, AbstractLoss))
"""


@pytest.mark.parametrize("at", ["Config", "fields_read", "fields_written", "problems", "__init__"])
def test_a_component_that_fails_names_its_distribution_and_shows_its_traceback(at, write, install):
    install("qgs-faulty", "faulty", FAULTY, version="0.3")
    model = f"model:\n  decoder: {{refinement: {{type: faulty/faulty, at: {at}}}}}\n"
    recipe = write(f"recipe: 1\nplugins: [faulty]\n{model}")
    with pytest.raises(RecipeError) as caught:
        compose(recipe)
    (problem,) = caught.value.problems
    assert (problem.line, problem.option) == (4, "model.decoder.refinement")
    for word in ("qgs-faulty 0.3", f"`{at}`", "KeyError: 'x'"):
        assert word in problem.reason
    assert "_test_qgs_faulty.py" in "".join(traceback.format_exception(caught.value))


def test_a_failing_loss_names_its_distribution_and_missing_data_is_a_users_mistake(write, install):
    install("qgs-faulty", "faulty", FAULTY, version="0.3")
    text = "losses: {x: {type: faulty/abstract}}\ndata: {type: faulty/closed}\n"
    recipe = resolve(write(f"recipe: 1\nplugins: [faulty]\n{text}"))
    assert "qgs-faulty 0.3" in refused(None, by=lambda _: recipe.build_losses()).reason
    with pytest.raises(FileNotFoundError, match="photos/"):
        recipe.build_data()


def test_the_tracebacks_of_several_plugins_are_all_shown(write, install):
    install("qgs-first", "first", "{}['x']\n")
    install("qgs-second", "second", "[][1]\n")
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [first, second]\n"))
    shown = "".join(traceback.format_exception(caught.value))
    assert "_test_qgs_first.py" in shown
    assert "_test_qgs_second.py" in shown


def test_a_plugin_in_memory_has_no_distribution():
    class Silent(LearnedQueries):
        name = "silent"
        count = 3

        def start(self, batch_size):
            raise NotImplementedError

        @classmethod
        def fields_written(cls, config):
            raise KeyError("oops")

    recipe = {"recipe": 1, "plugins": ["mine"], "model": {"queries": {"type": "mine/silent"}}}
    problem = refused(recipe, plugins=[Plugin("mine", CONTRACT_VERSION, (Silent,))])
    assert problem.reason.startswith("the plugin `mine` fails: `fields_written` of `mine/silent`")
