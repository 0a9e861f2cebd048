"""Merging, swapping, provenance, and what a resolved recipe is."""

import re
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused

from qgs.composer import RecipeError, compose, resolve
from qgs.composer.errors import Origin, Problems
from qgs.composer.files import merge
from qgs.composer.recipe import annotated
from qgs.composer.slots import SECTIONS
from qgs.composer.yaml_text import dump, from_plain, load_text

SMALL = {
    "recipe": 1,
    "model": {
        "width": 16,
        "heads": 2,
        "encoder": {"depth": 1},
        "queries": {"count": 4},
        "decoder": {"depth": 3},
        "head": {"gaussians_per_query": 2},
        "supervision": {"layers": [3]},
    },
}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("1.", 1.0),
        (".5", 0.5),
        ("-3", -3),
        ("0o17", 15),
        ("0xff", 255),
        ("017", 17),
        ("1_000", "1_000"),
        ("off", "off"),
        ("yes", "yes"),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("true", True),
        ("False", False),
        ("~", None),
        ("", None),
        ("'1'", "1"),
        ("-.inf", -float("inf")),
        ("[a, *x]", None),
    ],
)
def test_yaml_12_scalars(text, value):
    problems = Problems()
    result = load_text(text, "f", problems)
    if "*" in text:
        with pytest.raises(RecipeError, match="f:1"):
            problems.raise_any()
        return
    assert result == value
    assert type(result) is type(value)


def test_anchors_and_aliases_are_written_out():
    assert load_text("a: &x {p: 1}\nb: *x\n", "f", Problems()) == {"a": {"p": 1}, "b": {"p": 1}}


WORDS = st.sampled_from(["1e-4", "off", "12:30", "true", "null", "", "0o17", ".5", "- a", "a: b"])
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=6) | WORDS
INTEGERS = st.integers(-(2**63) + 1, 2**63 - 1)
SCALARS = st.none() | st.booleans() | INTEGERS | st.floats(allow_nan=False) | TEXTS


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.dictionaries(TEXTS, SCALARS | st.lists(SCALARS, max_size=3), max_size=4))
def test_what_is_dumped_is_read_back(value):
    assert load_text(dump(value), "f", Problems()) == value


INTEGERS = st.integers(-(2**63) + 1, 2**63 - 1)
TREES = st.dictionaries(
    st.sampled_from("abc"),
    st.recursive(
        INTEGERS | st.lists(INTEGERS, max_size=2),
        lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
        max_leaves=6,
    ),
)


@settings(max_examples=60, deadline=None)
@given(TREES, TREES)
def test_merging_twice_is_merging_once_and_nothing_changes_nothing(a, b):
    a, b, empty = (from_plain(tree, Origin("f")) for tree in (a, b, {}))
    assert merge(a, a) == a
    assert merge(merge(a, b), b) == merge(a, b)
    assert merge(empty, a) == merge(a, empty) == a


def test_annotated_recipe_composes_again(write):
    recipe = resolve(SMALL)
    assert resolve(write(annotated(recipe))).tree == recipe.tree


def test_extends_merges_mappings_replaces_lists_and_replaces_nodes_of_another_type(write):
    write(
        """
        recipe: 1
        model:
          head: {norm: true, init_std: 0.1}
          queries: {count: 7, std: 0.3}
          supervision: {layers: [3, 12]}
        """,
        "a.yaml",
    )
    write("recipe: 1\nmodel:\n  head: {init_std: 0.2}\n", "b.yaml")
    recipe = write(
        """
        recipe: 1
        extends: [a.yaml, b.yaml]
        model:
          queries: {type: qgs/latent, std: 0.4}
          supervision: {layers: [5]}
        """
    )
    model = resolve(recipe).tree["model"]
    assert model["head"]["norm"] is True
    assert model["head"]["init_std"] == 0.2
    assert model["queries"] == {"type": "qgs/latent", "count": 7, "std": 0.4}
    assert model["supervision"]["layers"] == [5]


def test_plugins_are_united_and_each_keeps_its_line(write, spatial, install):
    source = "from qgs.components import LatentQueries\nfrom qgs.contracts import Plugin\n"
    for name in ("first", "second"):
        listed = f"plugin = Plugin('{name}', 1, (LatentQueries,))\n"
        install(f"qgs-{name}", name, source + listed)
    write("recipe: 1\nplugins: [spatial]\ndata: {type: spatial/scenes}\n", "a.yaml")
    queries = "model: {queries: {type: first/latent}}\n"
    write(f"recipe: 1\n\nplugins: [first, spatial]\n{queries}", "b.yaml")
    overlay = write("recipe: 1\nextends: [a.yaml, b.yaml]\nplugins:\n- first\n")
    recipe = resolve(overlay, ["plugins=[second]"])
    assert recipe.tree["plugins"] == ["spatial", "first"], "nothing is of `second`"
    assert set(recipe.releases) == {"qgs", "spatial", "first"}
    assert recipe.provenance["plugins"] == "a.yaml:2, b.yaml:3"
    recipe = resolve(overlay, ["plugins=[second]", "model.queries.type=second/latent"])
    assert recipe.tree["plugins"] == ["spatial", "second"]
    assert recipe.provenance["plugins"] == "a.yaml:2, --set #1"
    assert resolve(SMALL | {"plugins": ["first"]}, ["plugins=null"]).tree["plugins"] == []
    problem = refused(overlay, ["plugins=[second, second]"])
    assert (problem.file, problem.option) == ("--set #1", "plugins.3")


def test_another_type_forgets_the_options_of_the_first(write, spatial):
    write("recipe: 1\nplugins: [spatial]\nmodel: {queries: {count: 7, std: 0.3}}\n", "a.yaml")
    overlay = "recipe: 1\nextends: a.yaml\nmodel: {queries: {type: spatial/placed}}\n"
    queries = resolve(write(overlay)).tree["model"]["queries"]
    assert queries == {"type": "spatial/placed", "count": 4, "radius": True}


def test_null_leaves_the_default(write):
    write("recipe: 1\nmodel: {head: {norm: true}}\ntraining: {steps: 3}\n", "a.yaml")
    overlay = "recipe: 1\nextends: a.yaml\nmodel: {head: null}\ntraining:\nlosses: {}\n"
    tree = resolve(write(overlay), ["model.head.position_std=0.1"]).tree
    assert tree["model"]["head"]["norm"] is False
    assert tree["training"]["steps"] == 150_000
    assert tree["losses"] == {}
    dropped = resolve({"recipe": 1, "losses": {"a": {"type": "qgs/photometric"}}}, ["losses.a="])
    assert dropped.tree["losses"] == {}


def test_defaults_that_stay_lie_under_what_is_written_and_null_drops_one(monkeypatch):
    monkeypatch.setitem(SECTIONS, "losses", replace(SECTIONS["losses"], defaults_stay=True))
    written = {"photometric": {"mse_weight": 2.0}, "visibility": None}
    recipe = resolve(SMALL | {"losses": written}, ["losses.mine.type=qgs/opacity"])
    assert list(recipe.build_losses()) == ["photometric", "mine"]
    assert recipe.tree["losses"]["photometric"]["mse_weight"] == 2.0
    assert recipe.tree["losses"]["visibility"] is None
    assert resolve(recipe.tree).tree == recipe.tree


def test_an_emptied_section_is_shown_with_what_emptied_it(write):
    shown = annotated(resolve(write("recipe: 1\nlosses: {}\n")))
    assert re.search(r"^losses: \{\} +# recipe.yaml:2$", shown, re.MULTILINE)
    emptied = resolve(SMALL, ["losses={a: {type: qgs/opacity}}", "losses={a: null}"])
    assert emptied.provenance["losses"] == "--set #2"


def test_overrides_are_read_like_files_and_the_last_wins():
    recipe = resolve(SMALL, ["optimizer.learning_rate=1e-4", "seed=3", "seed=0o10"])
    assert recipe.tree["optimizer"]["learning_rate"] == 1e-4
    assert recipe.seed == 8
    assert recipe.provenance["seed"] == "--set #3"


def test_provenance_names_file_line_override_or_default(write):
    write("recipe: 1\nmodel:\n  queries: {count: 3}\n  head:\n    norm: true\n", "a.yaml")
    recipe = write("recipe: 1\nextends: a.yaml\nmodel:\n  head:\n    init_std: 0.1\n")
    origin = resolve(recipe, ["model.queries.std=1"]).provenance
    assert origin["model.queries.count"] == "a.yaml:3"
    assert origin["model.queries.std"] == "--set #1"
    assert origin["model.queries.type"] == "default of the slot"
    assert origin["model.head.norm"] == "a.yaml:5"
    assert origin["model.head.init_std"] == "recipe.yaml:5"
    assert origin["model.head.quat_eps"] == "default of qgs/gaussian_head"
    assert origin["model.width"] == "default"


def test_swap_changes_every_place_and_gives_a_readable_tree(write):
    write("recipe: 1\nmodel: {decoder: {depth: 4}, supervision: {layers: [4]}}\n", "a.yaml")
    everywhere = write(
        "recipe: 1\nextends: a.yaml\nswap:\n"
        "  model.decoder.layers.*.feed_forward: {type: qgs/mlp, ratio: 2}\n"
    )
    tree = resolve(everywhere).tree
    assert tree["model"]["decoder"]["feed_forward"]["ratio"] == 2
    assert "layers" not in tree["model"]["decoder"]
    assert "swap" not in tree
    once = resolve(everywhere, ["swap={model.decoder.layers.*.feed_forward: null}"])
    assert once.tree["model"]["decoder"]["feed_forward"]["ratio"] == 4
    some = resolve(
        {"recipe": 1, "swap": {"decoder.layers.[13].feed_forward": {"type": "qgs/mlp", "ratio": 3}}}
    )
    layers = some.tree["model"]["decoder"]["layers"]
    assert list(layers) == ["1", "3"]
    for layer in layers.values():
        assert list(layer) == ["feed_forward"]
        assert layer["feed_forward"].items() >= {"type": "qgs/mlp", "ratio": 3}.items()
    assert resolve(some.tree).tree == some.tree


def test_layer_override_lies_over_the_template():
    decoder = {"feed_forward": {"ratio": 2}, "layers": {1: {"feed_forward": {"ratio": 5}}}}
    recipe = resolve(SMALL | {"model": SMALL["model"] | {"decoder": decoder | {"depth": 3}}})
    ratios = [layer.feed_forward.mlp.fc1.out_features for layer in recipe.build_model().decoder]
    assert ratios == [32, 80, 32]


def test_same_recipe_same_parameters_and_the_global_random_state_stays():
    before = torch.get_rng_state()
    first, second = compose(SMALL).state_dict(), compose(SMALL).state_dict()
    other = compose(SMALL, ["seed=1"]).state_dict()
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["queries.features"], other["queries.features"])


def test_layers_with_equal_refinement_share_a_module_unless_it_forbids_that(install):
    assert len(compose(SMALL, device="meta").refinements) == 1
    install(
        "qgs-apart",
        "apart",
        """
        from qgs.contracts import Plugin, Refinement
        class Apart(Refinement):
            name = "apart"
            shared_by_layers = False
            def forward(self, state):
                return state
        plugin = Plugin("apart", 1, (Apart,))
        """,
    )
    overrides = ["plugins=[apart]", "model.decoder.refinement.type=apart/apart"]
    assert len(compose(SMALL, overrides, device="meta").refinements) == 3


def test_null_type_is_the_default_of_the_slot():
    assert resolve(SMALL, ["model.queries.type=null"]).tree == resolve(SMALL).tree


def test_recipe_without_data_and_mapping_with_a_value_that_yaml_cannot_hold():
    with pytest.raises(ValueError, match="this recipe has no data"):
        resolve(SMALL).build_data()
    with pytest.raises(ValueError, match="`seed` is a Tensor"):
        resolve({"recipe": 1, "seed": torch.zeros(1)})


def test_missing_file_suggests_its_neighbour(write):
    write("recipe: 1\n", "tokengs.yaml")
    with pytest.raises(RecipeError, match=r"did you mean `tokengs\.yaml`"):
        resolve("tokngs.yaml")
