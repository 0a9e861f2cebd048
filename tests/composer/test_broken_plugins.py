"""Plugins that are broken, and components that cannot stand together."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from qgs.cli import app
from qgs.composer import RecipeError
from qgs.composer.recipe import resolve
from qgs.composer.registry import load_sound_plugins


def test_a_component_that_refines_a_field_is_no_provider_of_it(write, install):
    install(
        "qgs-chain",
        "chain",
        """
        from qgs.contracts import FieldSpec, Plugin, Refinement
        class Refine(Refinement):
            name = "refine"
            @classmethod
            def requires(cls, config):
                return {"place": FieldSpec((3,))}
            provides = requires
            def forward(self, state):
                return state
        plugin = Plugin("chain", 1, (Refine,))
        """,
    )
    text = "recipe: 1\nplugins: [chain]\nmodel: {decoder: {refinement: {type: chain/refine}}}\n"
    with pytest.raises(RecipeError) as caught:
        resolve(write(text))
    (problem,) = caught.value.problems
    assert "needs place" in problem.reason
    assert "too late" not in problem.reason


def test_fix_names_only_what_would_help(write, install):
    install(
        "qgs-chain",
        "chain",
        """
        from qgs.contracts import CrossAttention, FieldSpec, Plugin, Queries, Refinement
        PLACE = {"place": FieldSpec((3,))}
        class Reader(CrossAttention):
            name = "reader"
            @classmethod
            def requires(cls, config):
                return PLACE
            def forward(self, state, memory):
                return state.features
        class Refine(Refinement):
            name = "refine"
            @classmethod
            def requires(cls, config):
                return PLACE
            provides = requires
            def forward(self, state):
                return state
        class Late(Refinement):
            name = "late"
            @classmethod
            def provides(cls, config):
                return PLACE
            def forward(self, state):
                return state
        class Start(Queries):
            name = "start"
            count = 3
            @classmethod
            def provides(cls, config):
                return PLACE
            def forward(self, batch_size):
                raise NotImplementedError
        plugin = Plugin("chain", 1, (Reader, Refine, Late, Start))
        """,
    )
    decoder = "model: {decoder: {cross_attention: {type: chain/reader}}}\n"
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [chain]\n" + decoder))
    (problem,) = caught.value.problems
    assert problem.fix == "use `chain/start` in the slot `queries`"


BROKEN_PLUGINS = {
    "raises at import": ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
    "is no Plugin": (
        "plugin = {}",
        "is no qgs.Plugin: its entry point leads to an object of type dict",
    ),
    "no object at its entry point": ("other = 1", "has no attribute 'plugin'"),
    "unlisted component": (
        "from qgs.components import LatentQueries\nfrom qgs.contracts import Plugin\n"
        "plugin = Plugin('bad', 1, LatentQueries)",
        "must give `components` as a tuple or a list, written `(Mine,)` for a single one",
    ),
    "nameless component": (
        "from qgs.components import LatentQueries\nfrom qgs.contracts import Plugin\n"
        "class Nameless(LatentQueries):\n    name = ''\n"
        "plugin = Plugin('bad', 1, (Nameless,))",
        "whose name '' is empty or has a slash or a blank",
    ),
    "option that no recipe can give": (
        "from collections.abc import Callable\nfrom qgs.contracts import Plugin\n"
        "from qgs.contracts import Centers, ComponentConfig\n"
        "class Odd(Centers):\n    name = 'odd'\n"
        "    class Config(ComponentConfig):\n        function: Callable = print\n"
        "    def forward(self, offsets, state):\n        return offsets\n"
        "plugin = Plugin('bad', 1, (Odd,))",
        "lists Odd, whose Config has options that YAML cannot express",
    ),
    "wrong contract version": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', 0, ())",
        "contract version 0",
    ),
    "contract version that is a text": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', '1', ())",
        "must give `contract_version` as a whole number, not '1'",
    ),
    "contract version that is a truth": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', True, ())",
        "must give `contract_version` as a whole number, not True",
    ),
    "nothing in it": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', 1, ())",
        "is empty: it lists neither `components` nor `layouts`",
    ),
    "other name": (
        "from qgs.contracts import Plugin\nplugin = Plugin('qgs', 1, ())",
        "calls itself `qgs`",
    ),
    "taken component name": (
        "from qgs.components import LatentQueries\nfrom qgs.contracts import Plugin\n"
        "plugin = Plugin('bad', 1, (LatentQueries, LatentQueries))",
        "registers `latent` twice",
    ),
    "abstract component": (
        "from qgs.contracts import Plugin, Queries\n"
        "class Half(Queries):\n    name = 'half'\n"
        "plugin = Plugin('bad', 1, (Half,))",
        "leaves count, forward abstract",
    ),
    "device that is none": (
        "from qgs.contracts import Plugin\nfrom qgs.renderers import TorchRenderer\n"
        "class Odd(TorchRenderer):\n    name = 'odd'\n    devices = ('tpu',)\n"
        "plugin = Plugin('bad', 1, (Odd,))",
        "lists Odd, whose `devices` is ('tpu',); give some of ('cpu', 'cuda', 'mps') as a tuple",
    ),
    "no component": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', 1, (int,))",
        "is no qgs component",
    ),
    "no layout": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', 1, (), layouts=(int,))",
        "lists <class 'int'>, which is no WeightLayout",
    ),
}


@pytest.mark.parametrize("name", BROKEN_PLUGINS)
def test_broken_plugin_is_reported_by_distribution(name, write, install):
    source, reason = BROKEN_PLUGINS[name]
    install("qgs-bad", "bad", source, version="0.7")
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [bad]\nmodel: {queries: {type: bad/any}}\n"))
    (problem,) = caught.value.problems
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


def test_fix_of_a_missing_dependency_is_to_install_it(write, install):
    install("qgs-hungry", "hungry", "import a_package_that_nobody_has.inside")
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [hungry]\n"))
    (problem,) = caught.value.problems
    assert "No module named 'a_package_that_nobody_has'" in problem.reason
    assert "install `a_package_that_nobody_has`, which qgs-hungry 1.2 needs" in problem.fix


@pytest.mark.parametrize("module", ["_test_qgs_stale.gone", "qgs.gone"])
def test_fix_of_a_module_that_a_release_lacks_is_another_release(module, write, install):
    install("qgs-stale", "stale", f"import {module}")
    with pytest.raises(RecipeError, match=r"fix: update qgs-stale 1\.2"):
        resolve(write("recipe: 1\nplugins: [stale]\n"))


def test_fix_of_a_module_that_is_gone_is_to_install_again(write, install):
    install("qgs-gone", "gone", "")
    Path(sys.path[0], "_test_qgs_gone.py").unlink()
    with pytest.raises(RecipeError, match=r"fix: install qgs-gone 1\.2 again"):
        resolve(write("recipe: 1\nplugins: [gone]\n"))


def test_fix_of_newer_contracts_is_a_newer_qgs(write, install):
    install("qgs-new", "new", "from qgs.contracts import Plugin\nplugin = Plugin('new', 99, ())")
    with pytest.raises(RecipeError, match="fix: update qgs, or do without"):
        resolve(write("recipe: 1\nplugins: [new]\n"))


def test_two_distributions_with_one_plugin_name(write, install):
    source = "from qgs.contracts import Plugin\nplugin = Plugin('twin', 1, ())"
    install("first-twin", "twin", source)
    install("second-twin", "twin", source)
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [twin]\n"))
    (problem,) = caught.value.problems
    assert "first-twin 1.2, second-twin 1.2" in problem.reason
    assert "uninstall" in problem.fix


def test_a_plugin_that_ends_the_process_at_import_is_reported(write, install):
    install("qgs-quits", "quits", "raise SystemExit(3)")
    with pytest.raises(RecipeError, match=r"qgs-quits 1\.2 cannot be imported"):
        resolve(write("recipe: 1\nplugins: [quits]\n"))


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
