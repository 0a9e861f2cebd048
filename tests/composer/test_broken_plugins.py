"""Plugins that are broken, and components that cannot stand together."""

from __future__ import annotations

import pytest

from qgs.composer import RecipeError, resolve


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
    assert (problem.line, problem.path) == (3, "model.decoder.refinement")
    assert f"`{name}` of `faulty/faulty` raises KeyError: 'oops'" in problem.reason
    assert "qgs-faulty 0.3" in problem.reason
    assert "qgs-faulty 0.3" in problem.fix


BROKEN_PLUGINS = {
    "raises at import": ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
    "is no Plugin": ("plugin = {}", "is no qgs.Plugin but dict"),
    "wrong contract version": (
        "from qgs.contracts import Plugin\nplugin = Plugin('bad', 99, ())",
        "contract version 99",
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
    assert (problem.file, problem.line, problem.path) == ("recipe.yaml", 2, "plugins.0")
    assert "qgs-bad 0.7" in problem.reason
    assert reason in problem.reason
    assert "qgs-bad 0.7" in problem.fix
    resolve(write("recipe: 1\n", "other.yaml"))


def test_two_distributions_with_one_plugin_name(write, install):
    source = "from qgs.contracts import Plugin\nplugin = Plugin('twin', 1, ())"
    install("first-twin", "twin", source)
    install("second-twin", "twin", source)
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\nplugins: [twin]\n"))
    (problem,) = caught.value.problems
    assert "first-twin 1.2, second-twin 1.2" in problem.reason
    assert "uninstall" in problem.fix
