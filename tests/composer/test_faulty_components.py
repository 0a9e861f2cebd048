"""Components of sound plugins whose own code fails, or does not do what it says."""

from __future__ import annotations

import re

import pytest
import torch

from qgs.composer import PluginError, RecipeError, compose
from qgs.composer.recipe import resolve
from qgs.contracts import Plugin, Queries
from qgs.types import Cameras, QueryState, Views


def test_config_whose_code_fails_is_reported_with_its_distribution(write, install):
    install(
        "qgs-faulty",
        "faulty",
        """
        from pydantic import field_validator
        from qgs.contracts import ComponentConfig, Plugin, Refinement
        class Faulty(Refinement):
            name = "faulty"
            class Config(ComponentConfig):
                step: int = 1
                @field_validator("step")
                @classmethod
                def _check(cls, step):
                    raise KeyError("oops")
            def forward(self, state):
                return state
        plugin = Plugin("faulty", 1, (Faulty,))
        """,
    )
    decoder = "model: {decoder: {refinement: {type: faulty/faulty, step: 2}}}\n"
    with pytest.raises(RecipeError, match=r"qgs-faulty 1\.2 fails: `Config` of `faulty/faulty`"):
        resolve(write("recipe: 1\nplugins: [faulty]\n" + decoder))


@pytest.mark.parametrize("name", ["requires", "provides", "problems"])
def test_component_whose_code_fails_is_reported_with_its_distribution(name, write, install):
    install(
        "qgs-faulty",
        "faulty",
        f"""
        from qgs.contracts import Plugin, Refinement
        class Faulty(Refinement):
            name = "faulty"
            @classmethod
            def {name}(cls, *anything):
                raise KeyError("oops")
            def forward(self, state):
                return state
        plugin = Plugin("faulty", 1, (Faulty,))
        """,
        version="0.3",
    )
    decoder = "model: {decoder: {refinement: {type: faulty/faulty}}}\n"
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [faulty]\n" + decoder))
    (problem,) = caught.value.problems
    assert (problem.line, problem.option) == (3, "model.decoder.refinement")
    assert f"`{name}` of `faulty/faulty` raises KeyError: 'oops'" in problem.reason
    assert "qgs-faulty 0.3" in problem.reason
    assert "qgs-faulty 0.3" in problem.fix


FAULTY = """
from qgs.contracts import CrossAttention, FieldSpec, Loss, Plugin, Queries, Refinement
from qgs.contracts import SceneSource
from qgs.types import QueryState
import torch

PLACE = {"place": FieldSpec((3,))}

class Exploding(Queries):
    name = "exploding"
    count = 3
    def __init__(self, config, dims):
        raise ValueError("no luck")
    def forward(self, batch_size):
        raise NotImplementedError

class ExplodingLoss(Loss):
    name = "exploding"
    def __init__(self, config):
        raise RuntimeError("no luck")
    def forward(self, prediction, rendering, target):
        raise NotImplementedError

class Closed(SceneSource):
    name = "closed"
    def __init__(self, config):
        raise FileNotFoundError("photos/ is not there")
    def scenes(self, split):
        raise NotImplementedError

class Silent(Queries):
    name = "silent"
    count = 3
    @classmethod
    def provides(cls, config):
        return PLACE
    def forward(self, batch_size):
        return QueryState(torch.zeros(batch_size, 3, self.dims.width))

class Shapeless(Refinement):
    name = "shapeless"
    @classmethod
    def provides(cls, config):
        return PLACE
    def forward(self, state):
        return state.replace(fields={"place": state.features[..., :2]})

class Losing(Refinement):
    name = "losing"
    def forward(self, state):
        return QueryState(state.features)

class Placed(Queries):
    name = "placed"
    count = 3
    provides = Silent.provides
    def forward(self, batch_size):
        place = torch.zeros(batch_size, 3, 3)
        return QueryState(torch.zeros(batch_size, 3, self.dims.width), {"place": place})

class Bare(Queries):
    name = "bare"
    count = 3
    def forward(self, batch_size):
        return torch.zeros(batch_size, 3, self.dims.width)

class Boasting(CrossAttention):
    name = "boasting"
    @classmethod
    def provides(cls, config):
        return PLACE
    def forward(self, state, memory):
        return state.features

STATES = (Silent, Shapeless, Losing, Placed, Bare, Boasting)
plugin = Plugin("faulty", 1, (Exploding, ExplodingLoss, Closed, *STATES))
"""

TINY = """
recipe: 1
plugins: [faulty]
model: {width: 16, heads: 2, encoder: {depth: 1}, queries: {count: 3},
        decoder: {depth: 1}, supervision: {layers: [1]}, head: {gaussians_per_query: 2}}
"""


@pytest.fixture
def faulty(install) -> None:
    install("qgs-faulty", "faulty", FAULTY, version="0.3")


def test_what_a_constructor_raises_is_reported_with_its_distribution(write, faulty):
    queries = "model: {queries: {type: faulty/exploding}}\n"
    recipe = resolve(write("recipe: 1\nplugins: [faulty]\n" + queries))
    with pytest.raises(RecipeError) as caught:
        recipe.build_model("meta")
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.option) == ("recipe.yaml", 3, "model.queries")
    assert "qgs-faulty 0.3" in problem.reason
    assert "`__init__` of `faulty/exploding` raises ValueError: no luck" in problem.reason


def test_what_a_loss_raises_when_built_is_reported_with_its_distribution(write, faulty):
    recipe = resolve(write("recipe: 1\nplugins: [faulty]\nlosses: {x: {type: faulty/exploding}}\n"))
    with pytest.raises(RecipeError, match=r"losses\.x\n.*qgs-faulty 0\.3"):
        recipe.build_losses()


def test_data_that_cannot_be_opened_is_told_as_it_is(write, faulty):
    recipe = resolve(write("recipe: 1\nplugins: [faulty]\ndata: {type: faulty/closed}\n"))
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
    model = compose(write(TINY), overrides)
    cameras = Cameras(torch.eye(4).expand(1, 1, 4, 4), torch.full((1, 1, 4), 8.0), (16, 16))
    with pytest.raises(PluginError, match=told) as caught:
        model(Views(torch.rand(1, 1, 3, 16, 16), cameras))
    assert f"qgs-faulty 0.3 fails: `faulty/{name}`" in caught.value.reason
    model = compose(write(TINY))
    assert model(Views(torch.rand(1, 1, 3, 16, 16), cameras)).gaussians.means.isfinite().all()


def test_a_plugin_in_memory_is_reported_without_a_distribution():
    class Silent(Queries):
        name = "silent"
        count = 3

        def forward(self, batch_size: int) -> QueryState:
            raise NotImplementedError

        @classmethod
        def provides(cls, config):
            raise KeyError("oops")

    recipe = {"recipe": 1, "plugins": ["mine"], "model": {"queries": {"type": "mine/silent"}}}
    with pytest.raises(RecipeError) as caught:
        resolve(recipe, plugins=[Plugin("mine", 1, (Silent,))])
    (problem,) = caught.value.problems
    assert problem.reason.startswith("the plugin `mine` fails: `provides` of `mine/silent` raises")
    place = rf"mend {re.escape(__file__)}:\d+, or choose another component"
    assert re.fullmatch(place, problem.fix)


def test_a_component_that_could_never_provide_what_it_says_is_refused(write, faulty):
    decoder = "model: {decoder: {cross_attention: {type: faulty/boasting}}}\n"
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [faulty]\n" + decoder))
    (problem,) = caught.value.problems
    assert "qgs-faulty 0.3" in problem.reason
    assert "`cross_attention` has no way to write" in problem.reason
