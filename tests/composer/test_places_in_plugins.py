"""The author of a plugin is shown the line of it that failed, and its user the release."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path

import pytest
import torch

from qgs.composer import PluginError, RecipeError, compose
from qgs.composer.build import build
from qgs.composer.recipe import resolve
from qgs.composer.registry import load_plugin
from qgs.types import QueryState

AT_IMPORT = {
    "error": ("import math\n\nTABLE = {}\nTABLE['x']\n", 4, "KeyError: 'x'"),
    "syntax": ("import math\n\ndef f(:\n    pass\n", 3, "SyntaxError: invalid syntax"),
    "deep": ("import json\n\nx = 1\n\njson.loads('}')\n", 5, "JSONDecodeError"),
    "exit": ("\nraise SystemExit(3)\n", 2, "SystemExit: 3"),
    "part that is not there": ("\n\nimport _test_qgs_faulty.part\n", 3, "ModuleNotFoundError"),
}

IN_CODE = """
from pydantic import field_validator
from qgs.components import LatentQueries
from qgs.contracts import ComponentConfig, Loss, Plugin, Refinement

def look_up(name):
    return {}[name]  # line 7

class Faulty(Refinement):
    name = "faulty"
    class Config(ComponentConfig):
        at: str = "nowhere"
        @field_validator("at")
        @classmethod
        def _check(cls, at):
            return look_up(at) if at == "Config" else at
    def __init__(self, config, dims):
        super().__init__(config, dims)
        look_up("x") if config.at == "__init__" else None
    @classmethod
    def provides(cls, config):
        return look_up("x") if config.at == "provides" else {}
    def forward(self, state):
        return state

plugin = Plugin("faulty", 1, (LatentQueries, Faulty))
"""

RECIPE = "recipe: 1\nplugins: [faulty]\nmodel: {decoder: {refinement: {type: faulty/faulty"


def file_of_the_plugin() -> str:
    return str(Path(sys.path[0], "_test_qgs_faulty.py"))


@pytest.mark.parametrize("editable", [True, False])
@pytest.mark.parametrize("name", AT_IMPORT)
def test_an_import_that_fails_is_placed(name, editable, write, install):
    source, line, told = AT_IMPORT[name]
    install("qgs-faulty", "faulty", source, editable=editable)
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [faulty]\n"))
    (problem,) = caught.value.problems
    place = f"{file_of_the_plugin()}:{line}"
    assert told in problem.reason
    assert problem.reason.endswith(f"(at {place})")
    assert problem.fix.startswith(f"mend {place}," if editable else "update qgs-faulty 1.2,")


def test_a_module_without_the_plugin_has_no_place(write, install):
    install("qgs-faulty", "faulty", "other = 1", editable=True)
    with pytest.raises(RecipeError, match=r"fix: mend `_test_qgs_faulty:plugin`, or do without"):
        resolve(write("recipe: 1\nplugins: [faulty]\n"))


@pytest.mark.parametrize("editable", [True, False])
@pytest.mark.parametrize("at", ["Config", "provides", "__init__"])
def test_a_component_that_fails_is_placed(at, editable, write, install):
    install("qgs-faulty", "faulty", IN_CODE, editable=editable)
    with pytest.raises(RecipeError) as caught:
        compose(write(f"{RECIPE}, at: {at}}}}}}}\n"))
    (problem,) = caught.value.problems
    place = f"{file_of_the_plugin()}:7"
    assert problem.reason.endswith(
        f"`{at}` of `faulty/faulty` raises KeyError: 'Config' (at {place})"
        if at == "Config"
        else f"`{at}` of `faulty/faulty` raises KeyError: 'x' (at {place})"
    )
    assert problem.fix.startswith(f"mend {place}," if editable else "update qgs-faulty 1.2,")


@pytest.mark.parametrize("at", ["import", "Config", "provides", "__init__"])
def test_the_traceback_shows_the_frames_of_the_plugin(at, write, install):
    install("qgs-faulty", "faulty", "{}['x']\n" if at == "import" else IN_CODE)
    with pytest.raises(RecipeError) as caught:
        compose(write(f"{RECIPE}, at: {at}}}}}}}\n"))
    shown = "".join(traceback.format_exception(caught.value))
    assert f'File "{file_of_the_plugin()}", line {1 if at == "import" else 7}' in shown


def test_the_tracebacks_of_several_plugins_are_all_shown(write, install):
    install("qgs-first", "first", "{}['x']\n")
    install("qgs-second", "second", "[][1]\n")
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [first, second]\n"))
    shown = "".join(traceback.format_exception(caught.value))
    assert "_test_qgs_first.py" in shown
    assert "_test_qgs_second.py" in shown


def test_a_broken_promise_is_placed_at_its_forward(write, install):
    source = """
    from qgs.contracts import Plugin, Refinement
    from qgs.geometry.precision import full_precision

    class Empty(Refinement):
        name = "empty"

        @full_precision
        def forward(self, state):  # line 9, its decorator 8
            return None

    plugin = Plugin("faulty", 1, (Empty,))
    """
    install("qgs-faulty", "faulty", source, editable=True)
    chosen = "{decoder: {refinement: {type: faulty/empty}}}"
    recipe = resolve(write(f"recipe: 1\nplugins: [faulty]\nmodel: {chosen}\n"))
    refine = build(recipe.parts["model", "decoder", "layers", "0", "refinement"], recipe.dims)
    with pytest.raises(PluginError, match="returns NoneType, not a QueryState") as caught:
        refine(QueryState(torch.zeros(1, 2, recipe.dims.width)))
    assert caught.value.fix == f"mend {file_of_the_plugin()}:8, or choose another component"


def test_an_installed_plugin_knows_whether_it_is_editable(install):
    source = "from qgs.components import LatentQueries\nfrom qgs.contracts import Plugin\n"
    for name, editable in (("mine", True), ("theirs", False)):
        listed = f"plugin = Plugin('{name}', 1, (LatentQueries,))\n"
        install(f"qgs-{name}", name, source + listed, editable=editable)
        assert load_plugin(name).editable is editable
