"""Plugins that cannot be used and components that fail: the distribution is named.

Those that are refused with a recipe are cases/plugins.txt.
"""

import traceback
from pathlib import Path

from commands import done
from refusals import refused
from tables import must_not_find, must_refuse, rows

from qgs.recipe import RecipeError, resolve
from qgs.recipe.registry import available_plugins, load_usable_plugins

EMPTY = "from qgs.contracts import Plugin\nplugin = Plugin('{}', 1, ())"
FAULTY = """
from pydantic import field_validator
from qgs.contracts import ComponentConfig, Loss, Plugin, Refinement, SceneSource, SelfAttention

class Strict(SelfAttention):
    name = "strict"
    class Config(ComponentConfig):
        word: str
        @field_validator("word")
        @classmethod
        def strict_check(cls, word):
            raise KeyError(word)
    def forward(self, state):
        raise NotImplementedError

class Silent(Refinement):
    name = "silent"
    @classmethod
    def fields_written(cls, config):
        raise KeyError("oops")
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

plugin = Plugin("faulty", 1, (Strict, Silent, Closed, AbstractLoss))
"""


def write(text):
    """Write a recipe into the working directory."""
    Path("recipe.yaml").write_text(text)
    return "recipe.yaml"


def test_one_name_of_two_distributions(here, install):
    for name in ("first-twin", "second-twin"):
        install(name, "twin", EMPTY.format("twin"))
    problem = refused(write("recipe: 1\nplugins: [twin]\n"))
    assert "first-twin 1.2, second-twin 1.2" in problem.reason


def test_broken_plugins_and_impostors_hide_no_other_plugin(here, install, monkeypatch):
    install("impostor", "qgs", EMPTY.format("qgs"))
    install("qgs-raises", "raises", "raise RuntimeError('no luck')")
    registry, broken = load_usable_plugins()
    assert sum("qgs-raises 1.2" in message for message in broken) == 1
    assert "qgs/latent" in registry.components("queries")
    resolve(write("recipe: 1\n"))
    monkeypatch.setenv("COLUMNS", "200")
    shown = done("list").output
    assert "qgs-raises 1.2" in shown
    assert "qgs/latent" in shown
    done("schema")


def test_a_plugin_that_comes_to_a_folder_or_leaves_it_is_noticed(tmp_path, monkeypatch):
    """Though what is installed is read once for as long as nothing changes."""
    monkeypatch.syspath_prepend(tmp_path)
    assert "late" not in available_plugins().names
    info = tmp_path / "late-1.0.dist-info"
    info.mkdir()
    (info / "entry_points.txt").write_text("[qgs.plugins]\nlate = late:plugin\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    assert "late" in available_plugins().names
    info.rename(tmp_path / "gone")
    assert "late" not in available_plugins().names


BROKEN = """
[first, second] | {}
[faulty] | {self_attention: {type: faulty/strict, word: x}}
[faulty] | {refinement: {type: faulty/silent}}
"""
"""Plugins, and options of the decoder."""


def test_the_tracebacks_of_plugins_and_components_are_all_shown(here, install):
    install("qgs-faulty", "faulty", FAULTY)
    for name in ("first", "second"):
        install(f"qgs-{name}", name, "{}['x']\n")
    shown = ""
    for plugins, decoder in rows(BROKEN):
        recipe = write(f"recipe: 1\nplugins: {plugins}\nmodel: {{decoder: {decoder}}}\n")
        error = must_refuse(None, resolve, recipe, kind=RecipeError)
        shown += "".join(traceback.format_exception(error))
    for word in ("_test_qgs_first.py", "_test_qgs_second.py", "strict_check", "fields_written"):
        assert word in shown


def test_what_fails_when_it_is_built_names_its_distribution_but_missing_data(here, install):
    install("qgs-faulty", "faulty", FAULTY)
    text = "losses: {x: {type: faulty/abstract}}\ndata: {type: faulty/closed}\n"
    recipe = resolve(write(f"recipe: 1\nplugins: [faulty]\n{text}"))
    reason = r"recipe.yaml:3: losses.x\n.*qgs-faulty 1\.2"
    error = must_refuse(reason, recipe.build_losses, kind=RecipeError)
    assert isinstance(error.__cause__, TypeError)
    must_not_find("photos/", recipe.build_data)
