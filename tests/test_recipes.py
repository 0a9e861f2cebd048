"""Promises of shipped recipes: alone, beside the papers' models, each other and the pages.

And the studies: each composes, at both sizes, from the same changes.
"""

import json
import re
from functools import cache
from pathlib import Path

import jsonschema
import pytest
import yaml
from fuzzing.cases import EVERY, RECIPES
from guide_pages import text_of
from published.files import read_golden
from published.splats import model_of
from qgs_research.studies.plan import composed, differences, planned
from qgs_research.studies.study import read_study
from tables import read_json

from qgs.recipe import resolve

IS_VALID = jsonschema.Draft202012Validator(read_json(RECIPES / "recipe.schema.json")).is_valid
STUDIES = [file for file in EVERY if file.startswith("studies/")]
FILES = [file for file in EVERY if file not in STUDIES]
OVERLAYS = (
    "finetune/dl3dv_2views.yaml",
    "finetune/dl3dv_4views.yaml",
    "finetune/dl3dv_6views.yaml",
    "rooms/budget_64.yaml",
)
"""Laid over recipes with data; they say nothing of its type."""

N = 4096
"""Queries of the published models."""
TOKENGS = 222_016_768
TOKENGS_2026_6 = 362_695_680
DYNAMIC = 360_076_288
LOCUSGS = 241_514_780 - 52_236
"""Without parameters that the published LocusGS carries and never uses."""
LANDMARK = TOKENGS - N * 1024 + 12_379_410
"""Without learned queries, with places, neighbours and the refinement."""
GSLRM = 303_548_416
"""The paper: 300 million in 24 blocks of width 1024."""
ABLATIONS = yaml.safe_load("""
reference: full
no_radius_state: no_radius_state
static_radius: static_radius
content_self_attention: content_self_attn
content_cross_attention: content_cross_attn
center_only_bias: center_only_bias
free_centers: free_center
anchor_offset: anchor_offset
""")
"""The golden file that the released code computed for it."""
PARAMETERS = {
    "tokengs/(re10k|dl3dv)": TOKENGS,
    "tokengs/latent_": TOKENGS_2026_6,
    "tokengs/dynamic": DYNAMIC,
    "landmark/(re10k|dl3dv)": LANDMARK,
    "gslrm/(re10k|dl3dv)": GSLRM,
    "locus/(re10k|dl3dv)|ablations/": LOCUSGS,
}
"""Parameters of recipes whose names begin so, with N queries in place of 1024."""
EQUALS = yaml.safe_load("""
tiny/c3g.yaml: tiny/tokengs.yaml
tiny/gslrm.yaml: tiny/locus.yaml
tiny/globalsplat.yaml: tiny/locus.yaml
""")
"""Other models, and the one whose budget they have."""


PAGE = text_of("experiments.md")
ZOO = [text_of(f"api/{name}.md") for name in ("mvsplat", "tokengs2026")]
NAMED = set(re.findall(r"[\w-]+/[\w-]+\.yaml", "".join([PAGE, *ZOO])))
SHOWN = dict(re.findall(r"`(ablations/\w+\.yaml)`.* \| ([\d,]+) \|$", PAGE, re.MULTILINE))


@cache
def recipe(file):
    return resolve(RECIPES / file)


def model(file, *overrides):
    return resolve(recipe(file).tree, overrides).build_model("meta")


def parameters(file, *overrides):
    return sum(parameter.numel() for parameter in model(file, *overrides).parameters())


def broken(promises):
    return [promise for promise, kept in promises.items() if not kept]


def changed(file, other):
    """Options of `other` that `file` changes: old value, new value."""
    return differences(recipe(other), recipe(file))


def keeps(file, other, *parts):
    paths = [path for path in changed(file, other) if path.startswith(parts)]
    return {f"has what {other} has, not another {paths}": paths == []}


def alone(file):
    ours = recipe(file)
    losses = ours.build_losses(pretrained=False)
    return {
        "resolves to itself": resolve(json.loads(json.dumps(ours.tree))).tree == ours.tree,
        "needs no memory": all(parameter.is_meta for parameter in model(file).parameters()),
        "has its losses": losses.keys() == ours.tree["losses"].keys() != set(),
        "warns of nothing": ours.warnings == [],
    }


def as_published(file, wanted):
    """The number of parameters, and the structure of ablations without sizes and initial values."""
    wanted = SHOWN.get(file, f"{wanted:,}")
    few = model(file).queries.count == 1024
    count = parameters(file, *[f"model.queries.count={N}"] * few)
    kept = {f"has {wanted} parameters, not {count:,}": f"{count:,}" == wanted}
    if golden := file.startswith("ablations/") and ABLATIONS.get(Path(file).stem):
        released = read_golden(RECIPES.parent / f"tests/golden/locus_{golden}_a.safetensors")
        theirs = structure(model_of(released).recipe["model"])
        kept["is the released variant"] = structure(recipe(file).tree["model"]) == theirs
    return kept


def structure(node):
    sizes = ("width", "heads", "count", "depth", "gaussians_per_query", "layers")
    if not isinstance(node, dict):
        return node
    return {key: structure(node[key]) for key in node.keys() - {*sizes, "init_std", "layer_scale"}}


def beside_its_twin(file, twin):
    """LocusGS is compared with TokenGS at one budget."""
    sections = ("data", "views", "optimizer", "training", "evaluation", "metrics")
    parts = ("model.width", "model.heads", "model.encoder", "model.renderer")
    numbers = ("model.queries.count", "model.head.gaussians_per_query", "model.decoder.depth")
    other_centres = "model.centers.type" in changed(file, twin)
    return {**keeps(file, twin, *sections, *parts, *numbers), "has other centres": other_centres}


def beside_its_equal(file):
    other = EQUALS[file]
    near = parameters(file) == pytest.approx(parameters(other), rel=0.1)
    return {**keeps(file, other, "data", "views", "training.seconds"), "is as large": near}


def beside_its_base(file):
    """A finetune changes no more than it says, beside the data and how they are seen and judged."""
    run = re.sub("_4096.*", "", file)
    changes = changed(file, f"{run}.yaml").items()
    found = {p: x for p, x in changes if not p.startswith(("data", "views", "evaluation"))}
    wanted = {
        "init_from": ("null", f"runs/{run}"),
        "model.queries.count": ("1024", "4096"),
        "optimizer.learning_rate": ("0.0004", "4.0e-05"),
        "optimizer.warmup": ("2000", "400"),
        "training.steps": (f"{300 * 500}", f"{(80 if 'dl3dv' in file else 20) * 500}"),
    }
    return {f"changes its base by {wanted}, not by {found}": found == wanted}


@pytest.mark.parametrize("file", FILES)
def test_a_recipe_keeps_its_promises(file):
    text = (RECIPES / file).read_text()
    promises = {
        "is valid": IS_VALID(yaml.safe_load(text)),
        "says what it is in `qgs recipes`": text.startswith("# "),
    }
    if file not in OVERLAYS:
        promises |= alone(file)
    for pattern, count in PARAMETERS.items():
        if re.match(pattern, file):
            promises |= as_published(file, count)
    twin = re.sub(r"^(tiny/)?locus\b", r"\1tokengs", file)
    if twin != file and twin in FILES:
        promises |= beside_its_twin(file, twin)
    if file in EQUALS:
        promises |= beside_its_equal(file)
    if re.match("(tokengs|locus)/.*_4096", file):
        promises |= beside_its_base(file)
    assert broken(promises) == []


TABLES = {"structural": "", "supervised_layers": "supervised_"}
"""Published studies of which each variant is an ablation, and how the recipe's name begins."""
NAMES = {"half_and_last": "6_12", "last": "12", "four": "3_6_9_12"}


@pytest.mark.parametrize("file", STUDIES)
def test_a_study_keeps_its_promises(file, tmp_path):
    study = read_study(RECIPES / file)
    claims = [hypothesis.claim for hypothesis in study.settings.hypotheses]
    promises = {"has hypotheses": claims != []}
    if "/tiny/" in file:
        plan = planned(study, tmp_path / "out")
        promises["has six runs"] = len(plan.runs) >= 6
        recipes = plan.recipes
    else:
        recipes = composed(study)
    promises["warns of nothing"] = not any(variant.warnings for variant in recipes.values())
    other = file.replace("/published/", "/tiny/")
    if other != file and other in STUDIES:
        tiny = read_study(RECIPES / other)
        shared = [hypothesis.claim for hypothesis in tiny.settings.hypotheses][: len(claims)]
        promises["varies as the tiny one"] = tiny.variants.keys() == study.variants.keys()
        promises["asks what the tiny one does"] = shared == claims
    if "/published/" in file and (prefix := TABLES.get(Path(file).stem)) is not None:
        for (name, _), variant in recipes.items():
            table = recipe(f"ablations/{prefix}{NAMES.get(name, name)}.yaml")
            sections = {path.split(".")[0] for path in differences(variant, table)}
            promises[f"has {name} of the tables"] = sections <= {"data", "evaluation"}
    assert broken(promises) == []


def test_documents_and_tables_name_recipes_that_there_are():
    named = NAMED | {*OVERLAYS, *EQUALS} | {f"ablations/{name}.yaml" for name in ABLATIONS}
    assert not named - {*FILES}
    assert len(SHOWN) == 8
    assert SHOWN["ablations/reference.yaml"] == f"{LOCUSGS:,}"
    assert not [x for x in PARAMETERS if not any(re.match(x, file) for file in FILES)]
