"""Code of plugins that fails or does not do what it says: its author is shown the line, its user
the release."""

import re
import sys
import traceback
from pathlib import Path

import pytest
import torch
from refusals import refused

from qgs.composer import PluginError, RecipeError, compose
from qgs.composer.build import build
from qgs.composer.recipe import resolve
from qgs.contracts import LearnedQueries, Plugin
from qgs.types import Cameras, QueryState, Views

SOURCE = """
from pydantic import field_validator
from qgs.contracts import ComponentConfig, CrossAttention, FieldSpec, Loss, Plugin, LearnedQueries
from qgs.contracts import Refinement, SceneSource
from qgs.types import QueryState
import torch

def look_up(name):
    return {}[name]  # line 9

class Faulty(Refinement):
    name = "faulty"
    class Config(ComponentConfig):
        at: str = "nowhere"
        @field_validator("at")
        @classmethod
        def _check(cls, at):
            return look_up("x") if at == "Config" else at
    def __init__(self, config, dims):
        super().__init__(config, dims)
        look_up("x") if config.at == "__init__" else None
    @classmethod
    def fields_read(cls, config):
        return look_up("x") if config.at == "fields_read" else {}
    @classmethod
    def fields_written(cls, config):
        return look_up("x") if config.at == "fields_written" else {}
    @classmethod
    def problems(cls, config, context):
        return look_up("x") if config.at == "problems" else ()
    def forward(self, state):
        return state

class ExplodingLoss(Loss):
    name = "exploding"
    def __init__(self, config):
        look_up("x")
    def term(self, prediction, rendering, target, inputs):
        raise NotImplementedError

class Closed(SceneSource):
    name = "closed"
    def __init__(self, config):
        raise FileNotFoundError("photos/ is not there")
    def scenes(self, split):
        raise NotImplementedError

PLACE = {"place": FieldSpec((3,))}

class Silent(LearnedQueries):
    name = "silent"
    count = 3
    @classmethod
    def fields_written(cls, config):
        return PLACE
    def start(self, batch_size):
        return QueryState(torch.zeros(batch_size, 3, self.dims.width))

class Shapeless(Refinement):
    name = "shapeless"
    fields_written = Silent.fields_written
    def forward(self, state):
        return state.replace(fields={"place": state.features[..., :2]})

class Losing(Refinement):
    name = "losing"
    def forward(self, state):
        return QueryState(state.features)

class Placed(LearnedQueries):
    name = "placed"
    count = 3
    fields_written = Silent.fields_written
    def start(self, batch_size):
        place = torch.zeros(batch_size, 3, 3)
        return QueryState(torch.zeros(batch_size, 3, self.dims.width), {"place": place})

class Bare(LearnedQueries):
    name = "bare"
    count = 3
    def start(self, batch_size):
        return torch.zeros(batch_size, 3, self.dims.width)

class Boasting(CrossAttention):
    name = "boasting"
    fields_written = Silent.fields_written
    def forward(self, state, memory):
        return state.features

STATES = (Silent, Shapeless, Losing, Placed, Bare, Boasting)
plugin = Plugin("faulty", 1, (Faulty, ExplodingLoss, Closed, *STATES))
"""

HEAD = "recipe: 1\nplugins: [faulty]\n"
TINY = f"""{HEAD}
model: {{width: 16, heads: 2, encoder: {{depth: 1}}, queries: {{count: 3}},
         decoder: {{depth: 1}}, supervision: {{layers: [1]}}, head: {{gaussians_per_query: 2}}}}
"""


@pytest.fixture
def faulty(install) -> None:
    install("qgs-faulty", "faulty", SOURCE, version="0.3")


def file_of_the_plugin() -> str:
    return str(Path(sys.path[0], "_test_qgs_faulty.py"))


def problem_of(write, text, build=resolve):
    with pytest.raises(RecipeError) as caught:
        build(write(HEAD + text))
    (problem,) = caught.value.problems
    return problem, "".join(traceback.format_exception(caught.value))


AT_IMPORT = {
    "error": ("import math\n\nTABLE = {}\nTABLE['x']\n", 4, "KeyError: 'x'"),
    "syntax": ("import math\n\ndef f(:\n    pass\n", 3, "SyntaxError: invalid syntax"),
    "deep": ("import json\n\nx = 1\n\njson.loads('}')\n", 5, "JSONDecodeError"),
    "exit": ("\nraise SystemExit(3)\n", 2, "SystemExit: 3"),
    "part that is not there": ("\n\nimport _test_qgs_faulty.part\n", 3, "ModuleNotFoundError"),
}


@pytest.mark.parametrize("editable", [True, False])
@pytest.mark.parametrize("name", AT_IMPORT)
def test_an_import_that_fails_is_placed(name, editable, write, install):
    source, line, told = AT_IMPORT[name]
    install("qgs-faulty", "faulty", source, editable=editable)
    problem, shown = problem_of(write, "")
    place = f"{file_of_the_plugin()}:{line}"
    assert told in problem.reason
    assert problem.reason.endswith(f"(at {place})")
    assert problem.fix.startswith(f"correct {place}," if editable else "update qgs-faulty 1.2,")
    assert f'File "{file_of_the_plugin()}", line {line}' in shown


def test_a_module_without_the_plugin_has_no_place(write, install):
    install("qgs-faulty", "faulty", "other = 1", editable=True)
    problem, _ = problem_of(write, "")
    assert problem.fix.startswith("correct `_test_qgs_faulty:plugin`, or do without")


@pytest.mark.parametrize("editable", [True, False])
@pytest.mark.parametrize("at", ["Config", "fields_read", "fields_written", "problems", "__init__"])
def test_a_component_that_fails_is_placed(at, editable, write, install):
    install("qgs-faulty", "faulty", SOURCE, version="0.3", editable=editable)
    model = f"model:\n  decoder: {{refinement: {{type: faulty/faulty, at: {at}}}}}\n"
    problem, shown = problem_of(write, model, compose)
    assert (problem.line, problem.option) == (4, "model.decoder.refinement")
    place = f"{file_of_the_plugin()}:9"
    assert problem.reason == (
        f"the plugin `faulty` of qgs-faulty 0.3 fails: `{at}` of `faulty/faulty` raises "
        f"KeyError: 'x' (at {place})"
    )
    assert problem.fix.startswith(f"correct {place}," if editable else "update qgs-faulty 0.3,")
    assert f'File "{file_of_the_plugin()}", line 9' in shown


def test_the_tracebacks_of_several_plugins_are_all_shown(write, install):
    install("qgs-first", "first", "{}['x']\n")
    install("qgs-second", "second", "[][1]\n")
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [first, second]\n"))
    shown = "".join(traceback.format_exception(caught.value))
    assert "_test_qgs_first.py" in shown
    assert "_test_qgs_second.py" in shown


def test_a_failing_loss_is_reported_with_its_distribution_and_missing_data_as_it_is(write, faulty):
    text = "losses: {x: {type: faulty/exploding}}\ndata: {type: faulty/closed}\n"
    recipe = resolve(write(HEAD + text))
    with pytest.raises(RecipeError, match=r"losses\.x\n.*qgs-faulty 0\.3"):
        recipe.build_losses()
    with pytest.raises(FileNotFoundError, match="photos/ is not there"):
        recipe.build_data()


SAYS = r"says that it provides place \(3 float32\), but "
LIES = {
    "silent": (
        ["model.queries={type: faulty/silent}"],
        SAYS + "the state that it returns has no field at all",
    ),
    "shapeless": (
        ["model.decoder.refinement={type: faulty/shapeless}"],
        SAYS + r"it returns one of trailing shape \(2,\)",
    ),
    "losing": (
        ["model.queries={type: faulty/placed}", "model.decoder.refinement={type: faulty/losing}"],
        "loses place: the state that it returns has no field at all",
    ),
    "bare": (["model.queries={type: faulty/bare}"], "returns Tensor, not a QueryState"),
}


@pytest.mark.parametrize("name", LIES)
def test_a_component_that_does_not_give_the_state_it_must_is_reported(name, write, faulty):
    overrides, told = LIES[name]
    cameras = Cameras(torch.eye(4).expand(1, 1, 4, 4), torch.full((1, 1, 4), 8.0), (16, 16))
    views = Views(torch.rand(1, 1, 3, 16, 16), cameras)
    model = compose(write(TINY), overrides)
    for _ in range(2):
        with pytest.raises(PluginError, match=told) as caught:
            model(views)
    assert f"qgs-faulty 0.3 fails: `faulty/{name}`" in caught.value.reason
    sound = compose(write(TINY))
    assert sound(views).gaussians.means.isfinite().all()
    assert not any(module._forward_hooks for module in sound.modules())


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
    recipe = resolve(write(HEAD + "model: {decoder: {refinement: {type: faulty/empty}}}\n"))
    refine = build(recipe.parts["model", "decoder", "layers", "0", "refinement"], recipe.dims)
    with pytest.raises(PluginError, match="returns NoneType, not a QueryState") as caught:
        refine(QueryState(torch.zeros(1, 2, recipe.dims.width)))
    assert caught.value.fix == f"correct {file_of_the_plugin()}:8, or choose another component"


def test_a_plugin_in_memory_is_reported_without_a_distribution():
    class Silent(LearnedQueries):
        name = "silent"
        count = 3

        def start(self, batch_size: int) -> QueryState:
            raise NotImplementedError

        @classmethod
        def fields_written(cls, config):
            raise KeyError("oops")

    recipe = {"recipe": 1, "plugins": ["mine"], "model": {"queries": {"type": "mine/silent"}}}
    problem = refused(recipe, plugins=[Plugin("mine", 1, (Silent,))])
    assert problem.reason.startswith(
        "the plugin `mine` fails: `fields_written` of `mine/silent` raises"
    )
    place = rf"correct {re.escape(__file__)}:\d+, or choose another component"
    assert re.fullmatch(place, problem.fix)


def test_a_component_that_could_never_provide_what_it_says_is_refused(write, faulty):
    model = "model: {decoder: {cross_attention: {type: faulty/boasting}}}\n"
    problem, _ = problem_of(write, model)
    assert "qgs-faulty 0.3" in problem.reason
    assert "`cross_attention` has no way to write" in problem.reason
