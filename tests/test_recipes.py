"""What the shipped recipes promise of each other, of the papers' models and of the documents."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from published.files import read_golden
from published.models import recipe_of

from qgs.composer import resolve

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"
OVERLAYS = (
    *(f"finetune/dl3dv_{views}views.yaml" for views in (2, 4, 6)),
    "rooms/budget_64.yaml",
)
"""Laid over recipes with data; they say nothing of its type."""

FILES = sorted(
    path.relative_to(RECIPES).as_posix()
    for path in {*RECIPES.rglob("*.yaml")} - {*RECIPES.glob("studies/**/*.yaml")}
)
EXPERIMENTS = ("re10k", "re10k_4096", "dl3dv", *(f"dl3dv_4096_{n}views" for n in (2, 4, 6)))
PAIRS = ["tiny/{}.yaml", *(f"{{}}/{name}.yaml" for name in EXPERIMENTS)]
ABLATIONS = {
    "reference": "full",
    "no_radius_state": "no_radius_state",
    "static_radius": "static_radius",
    "content_self_attention": "content_self_attn",
    "content_cross_attention": "content_cross_attn",
    "center_only_bias": "center_only_bias",
    "free_centers": "free_center",
    "anchor_offset": "anchor_offset",
}
"""Structural ablations and the golden files that the released code computed for them."""


def document(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("file", sorted({*FILES} - {*OVERLAYS}))
def test_every_recipe_resolves_to_itself_and_builds_without_memory(file: str) -> None:
    recipe = resolve(RECIPES / file)
    assert resolve(json.loads(json.dumps(recipe.tree))).tree == recipe.tree
    model = recipe.build_model("meta")
    assert {parameter.device.type for parameter in model.parameters()} == {"meta"}
    assert model.recipe == recipe.tree
    assert recipe.build_losses(pretrained=False).keys() == recipe.tree["losses"].keys() != set()
    following = [part for part in recipe.schedules.values() if recipe.training.seconds]
    assert all("schedules count steps" in text for text in recipe.warnings)
    assert bool(recipe.warnings) == bool(following)


@pytest.mark.parametrize("pair", PAIRS)
def test_tokengs_and_locusgs_have_the_same_budget(pair: str) -> None:
    ours, theirs = (resolve(RECIPES / pair.format(name)) for name in ("tokengs", "locus"))
    for section in ("data", "views", "optimizer", "training", "evaluation", "metrics"):
        assert ours.tree.get(section) == theirs.tree.get(section)
    for section in ("width", "heads", "encoder", "renderer"):
        assert ours.tree["model"][section] == theirs.tree["model"][section]
    first, second = ours.build_model("meta"), theirs.build_model("meta")
    assert first.queries.count == second.queries.count
    assert first.head.gaussians_per_query == second.head.gaussians_per_query
    assert first.depth == second.depth
    assert type(first.centers) is not type(second.centers)


@pytest.mark.parametrize(
    "pair", [("c3g", "tokengs"), ("gslrm", "locus"), ("globalsplat", "locus")], ids="-".join
)
def test_tiny_recipes_of_other_models_have_the_same_budget(pair: tuple[str, str]) -> None:
    ours, theirs = (resolve(RECIPES / f"tiny/{name}.yaml") for name in pair)
    for section in ("data", "views"):
        assert ours.tree[section] == theirs.tree[section]
    assert ours.training.seconds == theirs.training.seconds
    sizes = [sum(p.numel() for p in r.build_model("meta").parameters()) for r in (ours, theirs)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_is_the_released_variant(name: str) -> None:
    ours = resolve(RECIPES / "ablations" / f"{name}.yaml").tree["model"]
    golden = read_golden(ROOT / "tests" / "golden" / f"locus_{ABLATIONS[name]}_a.safetensors")
    released = resolve(recipe_of(golden)).tree["model"]
    assert _structure(ours) == _structure(released)


SIZES = ("width", "heads", "count", "depth", "gaussians_per_query", "layers")
STARTS = ("init_std", "layer_scale")


def _structure(node: Any) -> Any:
    """What is left of a model's recipe without sizes and initial values."""
    if not isinstance(node, dict):
        return node
    return {key: _structure(value) for key, value in node.items() if key not in SIZES + STARTS}


def test_every_recipe_has_its_place_in_the_documents() -> None:
    named = set(re.findall(r"[\w-]+/[\w-]+\.yaml", document("docs/experiments.md")))
    tiny = set(
        re.findall(r"recipes/([\w/-]+\.yaml)", document("README.md") + document("docs/photos.md"))
    )
    assert [file for file in FILES if file not in named | tiny] == []
    assert sorted(named - set(FILES)) == []


@pytest.mark.parametrize("model", ["tokengs", "locus"])
@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if "4096" in name])
def test_finetunes_change_no_more_than_they_say(model: str, name: str) -> None:
    base = resolve(RECIPES / model / f"{name.partition('_')[0]}.yaml")
    finetune = resolve(RECIPES / model / f"{name}.yaml")
    assert finetune.init_from == f"runs/{model}/{name.partition('_')[0]}"
    assert base.tree["model"]["queries"]["count"] == 1024
    grown = {**base.tree["model"]["queries"], "count": 4096}
    assert finetune.tree["model"] == {**base.tree["model"], "queries": grown}
    assert finetune.tree["losses"] == base.tree["losses"]
    assert finetune.training.steps in (20 * 500, 80 * 500)
    rate = finetune.tree["optimizer"]
    assert (rate["learning_rate"], rate["warmup"]) == (4e-5, 400)
    assert base.training.steps == 300 * 500
    rate = base.tree["optimizer"]
    assert (rate["learning_rate"], rate["warmup"]) == (4e-4, 2000)
