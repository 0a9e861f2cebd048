"""Every mistake gets one message with file, line, path, reason and fix."""

from itertools import pairwise

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
        3, "model.queries.count", "must be a valid integer, got the string 'many'", "fits",
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
        "`spatial/measure` at model.decoder.refinement (recipe.yaml:7) provides it too late",
        "bandwidth: fixed",
    ),
    "fields of different frames": (
        HEAD + "model:\n  queries: {type: spatial/placed}\n  decoder:\n"
        "    refinement: {type: spatial/local}\n",
        6, "model.decoder.refinement",
        "camera frame, `spatial/placed` at model.queries (recipe.yaml:4) writes",
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
        3, "model.queries.count", "must be a valid integer, got the number 0.0001", "4096",
    ),
    "off": (
        "recipe: 1\nmodel:\n  head: {norm: off}\n",
        3, "model.head.norm", "must be a valid boolean, got the string 'off'", "write `false`",
    ),
    "infinity": (
        "recipe: 1\nmodel:\n  queries: {std: .inf}\n",
        3, "model.queries.std", "must be a finite number", "give a value that fits",
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
        4, "model.queries.count", "must be greater than or equal to 1, got the number -4",
        "give a value that fits (default: 4096)",
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
    "data without a type": (
        "recipe: 1\ndata: {image_size: [64, 64]}\n",
        2, "data.type", "no `type` is given, and the slot `data` has no default",
        "add `type:`, one of qgs/chunks, qgs/dl3dv, qgs/photos",
    ),
    "type that is called otherwise today": (
        "recipe: 1\ndata: {type: qgs/rooms}\n",
        2, "data.type", "`qgs/rooms` has another name", "`plugins: [rooms]`",
    ),
    "aliases of aliases": (
        "recipe: 1\nseed:\n- &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(f"- &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefg")),
        3, "", "more than 20,000 values", "fewer aliases",
    ),
    "loss without a type": (
        "recipe: 1\nlosses:\n  mine: {weight: 0.1}\n",
        3, "losses.mine.type", "no default component", "add `type:`",
    ),
    "too few items": (
        "recipe: 1\nviews: {gap: [5]}\n",
        2, "views.gap", "needs 2 items, got 1", "give 2 items (default: [10, 40])",
    ),
    "no items": (
        "recipe: 1\ndata: {type: qgs/chunks, path: x, image_size: []}\n",
        2, "data.image_size", "needs 2 items, got 0", "give 2 items",
    ),
    "too many items": (
        "recipe: 1\nviews: {gap: [5, 6, 7]}\n",
        2, "views.gap", "must have at most 2 items, not 3", "give a value that fits",
    ),
    "gap in the wrong order": (
        "recipe: 1\nviews:\n  gap: [9, 4]\n",
        3, "views.gap", "1 <= min <= max, got [9, 4]", "write [4, 9]",
    ),
    "image without height": (
        "recipe: 1\ndata:\n  type: qgs/chunks\n  path: x\n  image_size: [0, 64]\n",
        5, "data.image_size.0", "must be greater than or equal to 1, got the number 0",
        "fits",
    ),
    "far before near": (
        "recipe: 1\nmodel:\n  renderer:\n    near: 3\n    far: 2\n",
        5, "model.renderer.far", "far must be more than near", "set far above 3",
    ),
    "near behind the default of far": (
        "recipe: 1\nmodel:\n  renderer: {near: 500}\n",
        3, "model.renderer", "got near 500 and far 125", "near below 125",
    ),
    "decay of 1": (
        "recipe: 1\noptimizer: {betas: [0.9, 1.0]}\n",
        2, "optimizer.betas.1", "must be less than 1, got the number 1.0",
        "fits (default: [0.9, 0.95])",
    ),
    "background out of range": (
        "recipe: 1\nmodel: {renderer: {background: [0, 0, 255]}}\n",
        2, "model.renderer.background.2", "must be less than or equal to 1, got the number 255",
        "fits",
    ),
    "LayerScale of nothing": (
        "recipe: 1\nmodel: {decoder: {layer_scale: 0}}\n",
        2, "model.decoder.layer_scale", "must be greater than 0, got the number 0", "fits",
    ),
    "supervised layers in the wrong order": (
        "recipe: 1\nmodel: {supervision: {layers: [4, 2, 2]}}\n",
        2, "model.supervision.layers", "must ascend from 1", "write [2, 4]",
    ),
    "nested too deep": (
        "recipe: 1\nseed:\n  " + "[" * 5000 + "]" * 5000 + "\n",
        3, "", "more than 64 deep", "flatter",
    ),
    "huge integer": (
        "recipe: 1\nmodel:\n  queries: {count: " + "9" * 5000 + "}\n",
        3, "model.queries.count", "an integer of 5000 digits does not fit", "a smaller number",
    ),
    "type that is a list": (
        "recipe: 1\nmodel:\n  queries: {type: [qgs/latent]}\n",
        3, "model.queries.type", "`type` names a component, got a list", "qgs/latent",
    ),
    "loss whose type is null": (
        "recipe: 1\nlosses:\n  mine: {type: null}\n",
        3, "losses.mine.type", "no default component", "add `type:`",
    ),
    "swap of a layer that has its own": (
        "recipe: 1\nmodel:\n  decoder:\n    layers:\n      3:\n        feed_forward: {ratio: 2}\n"
        "swap:\n  decoder.layers.*.feed_forward: {type: qgs/mlp}\n",
        8, "swap.decoder.layers.*.feed_forward",
        "`model.decoder.layers.3.feed_forward` is already set for this layer at recipe.yaml:6",
        "narrow the pattern, or remove",
    ),
    "swap dropped that nobody made": (
        "recipe: 1\nswap:\n  decoder.layers.*.feed_forward: null\n",
        3, "swap.decoder.layers.*.feed_forward", "no inherited swap", "remove this line",
    ),
    "plugin listed twice": (
        "recipe: 1\nplugins: [spatial, spatial]\n",
        2, "plugins.1", "already listed at recipe.yaml:2", "once",
    ),
    "two unmet requirements": (
        HEAD + "model:\n  decoder:\n    cross_attention: {type: spatial/near}\n",
        5, "model.decoder.cross_attention",
        "needs place.center (3 float32, world frame) and place.radius (1 float32, world frame)",
        "use `spatial/placed` in the slot `queries`",
    ),
    "data without losses": (
        "recipe: 1\nlosses: {photometric: null, visibility: null}\n"
        "data: {type: qgs/photos, path: photos}\n",
        2, "losses", "a recipe with data needs at least one loss", "add one under `losses`",
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
    assert (problem.file, problem.line, problem.option) == ("recipe.yaml", line, path)
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
    found = [(problem.file, problem.line, problem.option) for problem in caught.value.problems]
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
