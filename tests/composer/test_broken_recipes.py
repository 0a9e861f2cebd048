"""Every mistake gets one message with file, line, path, reason and fix."""

from __future__ import annotations

import pytest

from qgs.composer import RecipeError, resolve

HEAD = "recipe: 1\nplugins: [spatial]\n"

# name: (recipe, line, path, words of the reason, words of the fix)
BROKEN = {
    "misspelt key": (
        "recipe: 1\nmodel:\n  quereis: {count: 3}\n",
        3, "model.quereis", "there is no key `quereis`", "did you mean `queries`",
    ),
    "misspelt option": (
        "recipe: 1\nmodel:\n  queries:\n    cuont: 3\n",
        4, "model.queries.cuont", "there is no option `cuont`", "did you mean `count`",
    ),
    "key in the wrong section": (
        "recipe: 1\nqueries: {count: 3}\n",
        2, "queries", "there is no key `queries`", "did you mean `model.queries`",
    ),
    "misspelt component": (
        "recipe: 1\nmodel:\n  queries: {type: qgs/latnet}\n",
        3, "model.queries.type", "no component `qgs/latnet`", "did you mean `qgs/latent`",
    ),
    "component of another slot": (
        "recipe: 1\nmodel:\n  queries: {type: qgs/mlp}\n",
        3, "model.queries.type", "belongs in the slot `feed_forward`", "qgs/latent",
    ),
    "component without its plugin's name": (
        "recipe: 1\nmodel:\n  queries: {type: latent}\n",
        3, "model.queries.type", "PLUGIN/NAME", "did you mean `qgs/latent`",
    ),
    "missing plugin": (
        "recipe: 1\nplugins: [absent]\n",
        2, "plugins.0", "no installed distribution offers a plugin `absent`", "install",
    ),
    "plugin installed but not listed": (
        "recipe: 1\nmodel:\n  queries: {type: spatial/placed}\n",
        3, "model.queries.type", "which this recipe does not use", "add `plugins: [spatial]`",
    ),
    "component of a plugin that is not installed": (
        "recipe: 1\nmodel:\n  queries: {type: zebra/placed}\n",
        3, "model.queries.type", "which this recipe does not use", "install the distribution",
    ),
    "wrong type": (
        "recipe: 1\nmodel:\n  queries: {count: many}\n",
        3, "model.queries.count", "must be an integer, got the string 'many'", "give an integer",
    ),
    "wrong choice": (
        HEAD + "model:\n  queries: {type: spatial/placed}\n  decoder:\n"
        "    cross_attention: {type: spatial/near, bandwidth: fixd}\n",
        6, "model.decoder.cross_attention.bandwidth", "must be 'radius' or 'fixed'",
        "did you mean `fixed`",
    ),
    "unmet requirement": (
        HEAD + "model:\n  queries: {type: spatial/placed, radius: false}\n  decoder:\n"
        "    cross_attention: {type: spatial/near}\n",
        6, "model.decoder.cross_attention", "`spatial/near` needs place.radius (1 float32",
        "set `model.queries.radius: true`",
    ),
    "requirement met too late": (
        HEAD + "model:\n  queries: {type: spatial/placed, radius: false}\n  decoder:\n"
        "    cross_attention: {type: spatial/near}\n    refinement: {type: spatial/measure}\n",
        6, "model.decoder.cross_attention",
        "`spatial/measure` at model.decoder.refinement provides it too late",
        "bandwidth: fixed",
    ),
    "fields of different frames": (
        HEAD + "model:\n  queries: {type: spatial/placed}\n  decoder:\n"
        "    refinement: {type: spatial/local}\n",
        6, "model.decoder.refinement", "camera frame, `spatial/placed` at model.queries writes",
        "choose another component",
    ),
    "duplicate key": (
        "recipe: 1\nmodel:\n  width: 64\n  width: 128\n",
        4, "model.width", "already given at recipe.yaml:3", "keep one",
    ),
    "swap that matches nothing": (
        "recipe: 1\nswap:\n  decoder.layer.*.cross_attention: {type: qgs/content}\n",
        3, "swap.decoder.layer.*.cross_attention", "matches no place",
        "did you mean `decoder.layers.*.cross_attention`",
    ),
    "two swaps on one place": (
        "recipe: 1\nswap:\n  decoder.layers.*.cross_attention: {type: qgs/content}\n"
        "  decoder.layers.3.cross_attention: {type: qgs/content}\n",
        4, "swap.decoder.layers.3.cross_attention", "already swapped by", "narrow",
    ),
    "swap without a type": (
        "recipe: 1\nswap:\n  decoder.layers.*.feed_forward: {ratio: 2}\n",
        3, "swap.decoder.layers.*.feed_forward", "without a `type`", "{type: PLUGIN/NAME",
    ),
    "1e-4 where an integer belongs": (
        "recipe: 1\nmodel:\n  queries: {count: 1e-4}\n",
        3, "model.queries.count", "must be an integer, got the number 0.0001", "default: 4096",
    ),
    "off": (
        "recipe: 1\nmodel:\n  head: {norm: off}\n",
        3, "model.head.norm", "must be true or false, got the string 'off'", "write `false`",
    ),
    "infinity": (
        "recipe: 1\nmodel:\n  queries: {std: .inf}\n",
        3, "model.queries.std", "must be a finite number", "finite",
    ),
    "tab": (
        "recipe: 1\nmodel:\n\twidth: 64\n",
        3, "", "a tab stands where YAML wants spaces", "indent with spaces",
    ),
    "no YAML": (
        "recipe: 1\nmodel: {width: 64\nseed: 3\n",
        3, "", "no valid YAML", "brackets",
    ),
    "empty file": ("", 1, "", "the file is empty", "recipe: 1"),
    "only a comment": ("# nothing yet\n", 1, "", "the file is empty", "recipe: 1"),
    "a list at the top": ("- recipe: 1\n", 1, "", "this is a list", "key: value"),
    "a list where a mapping belongs": (
        "recipe: 1\nmodel:\n  decoder:\n    - depth: 3\n",
        3, "model.decoder", "`decoder` is a mapping, this is a list", "key: value",
    ),
    "a list where a component belongs": (
        "recipe: 1\nmodel:\n  queries: [3]\n",
        3, "model.queries", "a component is a mapping, this is a list", "type: PLUGIN/NAME",
    ),
    "import path in type": (
        "recipe: 1\nmodel:\n  queries: {type: torch.nn.Linear}\n",
        3, "model.queries.type", "is an import path", "entry points `qgs.plugins`",
    ),
    "import path with a colon": (
        "recipe: 1\nmodel:\n  queries: {type: 'my.module:Class'}\n",
        3, "model.queries.type", "is an import path", "entry points `qgs.plugins`",
    ),
    "python tag": (
        "recipe: 1\nseed: !!python/object/apply:os.getcwd []\n",
        2, "seed", "the tag 'tag:yaml.org,2002:python/object/apply:os.getcwd'", "remove the tag",
    ),
    "merge key": (
        "recipe: 1\nmodel:\n  <<: {width: 64}\n",
        3, "model.<<", "merge keys", "`extends`",
    ),
    "negative count": (
        "recipe: 1\nmodel:\n  queries:\n    count: -4\n",
        4, "model.queries.count", "must be at least 1, got the number -4", "at least 1",
    ),
    "heads that do not divide the width": (
        "recipe: 1\nmodel:\n  width: 128\n  heads: 5\n",
        4, "model.heads", "5 heads do not divide the width 128", "set model.heads to 4",
    ),
    "image size that the patch does not divide": (
        HEAD + "model:\n  encoder: {patch_size: 7}\ndata: {type: spatial/scenes}\n",
        4, "model.encoder.patch_size", "patches of 7 do not divide images of 64 x 64",
        "data.image_size",
    ),
    "supervised layer beyond the decoder": (
        "recipe: 1\nmodel:\n  decoder: {depth: 3}\n  supervision: {layers: [2, 4]}\n",
        4, "model.supervision.layers", "layers [4] do not exist", "1 to 3",
    ),
    "override of a layer that does not exist": (
        "recipe: 1\nmodel:\n  decoder:\n    layers:\n      12: {feed_forward: {ratio: 2}}\n",
        5, "model.decoder.layers.12", "there is no layer `12`", "0 to 11",
    ),
    "missing recipe version": (
        "seed: 1\n",
        1, "recipe", "missing", "recipe: ...",
    ),
    "newer recipe version": ("recipe: 2\n", 1, "recipe", "must be 1", "choose 1"),
    "loss without a type": (
        "recipe: 1\nlosses:\n  mine: {weight: 0.1}\n",
        3, "losses.mine.type", "no default component", "add `type:`",
    ),
    "missing base": (
        "recipe: 1\nextends: bases.yaml\n",
        2, "extends", "bases.yaml does not exist", "relative to the file it stands in",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_one_message_says_it_all(name, write, spatial):
    text, line, path, reason, fix = BROKEN[name]
    with pytest.raises(RecipeError) as caught:
        resolve(write(text))
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.path) == ("recipe.yaml", line, path)
    assert reason in problem.reason
    assert fix in problem.fix
    for words in (f"recipe.yaml:{line}", path, problem.reason, problem.fix):
        assert words in str(caught.value)


def test_all_errors_come_together_sorted_by_line(write, spatial):
    recipe = write("""
        recipe: 1
        plugins: [absent]
        model:
          width: 128
          width: 256
          queries: {count: -1, std: off, typo: 1}
          decoder: {feed_forward: {type: qgs/content}}
        training: {stesp: 5}
    """)
    with pytest.raises(RecipeError) as caught:
        resolve(recipe, ["model.head.norm=3"])
    found = [(problem.file, problem.line, problem.path) for problem in caught.value.problems]
    assert found == [
        ("--set #1", 0, "model.head.norm"),
        ("recipe.yaml", 2, "plugins.0"),
        ("recipe.yaml", 5, "model.width"),
        ("recipe.yaml", 6, "model.queries.count"),
        ("recipe.yaml", 6, "model.queries.std"),
        ("recipe.yaml", 6, "model.queries.typo"),
        ("recipe.yaml", 7, "model.decoder.feed_forward.type"),
        ("recipe.yaml", 8, "training.stesp"),
    ]
    assert str(caught.value).startswith("8 problems")


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


def test_cycle_is_named_with_its_whole_chain(write):
    write("recipe: 1\nextends: b.yaml\n", "a.yaml")
    write("recipe: 1\nextends: c.yaml\n", "b.yaml")
    write("recipe: 1\nextends: a.yaml\n", "c.yaml")
    with pytest.raises(RecipeError) as caught:
        resolve("a.yaml")
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.path) == ("c.yaml", 2, "extends")
    assert "a.yaml -> b.yaml -> c.yaml -> a.yaml" in problem.reason
    assert "remove" in problem.fix


def test_mistake_in_an_extended_file_is_found_there(write):
    write("recipe: 1\nmodel:\n  queries: {count: 0}\n", "base.yaml")
    recipe = write("recipe: 1\nextends: base.yaml\nmodel:\n  queries: {std: 0.5}\n")
    with pytest.raises(RecipeError) as caught:
        resolve(recipe)
    (problem,) = caught.value.problems
    assert (problem.file, problem.line) == ("base.yaml", 3)


@pytest.mark.parametrize(
    ("override", "path", "reason"),
    [
        ("model.queries.count", "model.queries.count", "is no override"),
        ("model..count=3", "model..count", "is no override"),
        ("model.queries.count=[1", "", "no valid YAML"),
        ("model.queries.count=x", "model.queries.count", "must be an integer"),
        ("extends=a.yaml", "extends", "cannot set"),
    ],
)
def test_broken_override(override, path, reason, write):
    with pytest.raises(RecipeError) as caught:
        resolve(write("recipe: 1\n"), ["seed=1", override])
    (problem,) = caught.value.problems
    assert (problem.file, problem.path) == ("--set #2", path)
    assert reason in problem.reason


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
