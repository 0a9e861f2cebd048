"""What a study may say, and what it is told otherwise: file, line, reason, remedy."""

import json
import re
import shutil
import textwrap

import pytest
from commands import done
from fuzzing.cases import RECIPES
from qgs_research.studies.plan import composed, planned, recipe_file, run_of, write_plan
from qgs_research.studies.study import parsed, read_study
from tables import must_refuse, read_json, write_json

from qgs.contracts import OptionError
from qgs.recipe import RecipeError, resolve

SOUND = f"""study: 1
base: {RECIPES}/tiny/locus.yaml
variants:
  full:
  flat: {{model: {{decoder: {{cross_attention: {{type: qgs/content}}}}}}}}
  tokengs: {RECIPES}/tiny/tokengs.yaml
reference: full
budget: {{steps: 200}}
differs: [losses.anchor_visibility]
hypotheses: [flat < full]
"""


def read(folder, text):
    (folder / "study.yaml").write_text(text)
    return read_study(folder / "study.yaml")


def cross_attention(recipe):
    return recipe.tree["model"]["decoder"]["cross_attention"]["type"]


def test_a_variant_is_the_base_or_its_own_recipe_with_the_budget(tmp_path):
    recipes = composed(read(tmp_path, SOUND))
    types = [r.tree["model"]["queries"]["type"] for r in recipes.values()]
    assert types == ["locus/anchored", "locus/anchored", "qgs/latent"]
    assert cross_attention(recipes["flat", ""]) == "qgs/content"
    for recipe in recipes.values():
        assert recipe.training.steps == 200
        assert recipe.training.seconds is None
        assert recipe.seed == 0
    training = composed(read(tmp_path, SOUND.replace("steps: 200", "seconds: 30")))[
        "full", ""
    ].training
    assert training.steps == 20_000
    assert training.seconds == 30.0


def test_a_study_extends_another_and_replaces_variants_by_name(tmp_path):
    read(tmp_path, SOUND)
    (tmp_path / "small.yaml").write_text(
        "study: 1\nextends: study.yaml\nvariants: {tokengs: null, flat: {model: {width: 64}}}\n"
        "overlay: {training: {batch_size: 1}}\nseeds: [7]\ndiffers: []\n"
    )
    recipes = composed(read_study(tmp_path / "small.yaml"))
    assert [*recipes] == [("full", ""), ("flat", "")]
    assert recipes["flat", ""].dims.width == 64
    assert cross_attention(recipes["flat", ""]) == "locus/ray_biased"
    assert all(r.training.batch_size == 1 and r.seed == 7 for r in recipes.values())


VARIANT = "{model: {decoder: {cross_attention: {type: qgs/content}}}}"
WRONG = r"""
reference: full | reference: ful | :7: reference | `full`
budget: {steps: 200} | budget: {steps: 200, seconds: 3} | :8: budget | steps or seconds
[flat < full] | [flat < fulll] | :10: hypotheses.0 | `full`
study: 1\n | study: 1\nsead: [0]\n | :2: sead | `seeds`
study: 1 | study: true | :1: study | true
variants:\n | variants:\nMANY | :3: variants | 200
reference | published: {full: good}\nreference | :7: published.full | number
qgs/content} | qgs/contents} | :5: variants.flat: model.decoder.cross_attention.type | `qgs/content`
  full:\n |   full: 3\n | :4: variants.full | `3`
  tokengs: |   ../up: | :6: variants.../up | letters
tiny/tokengs.yaml | tiny/tokens.yaml | :6: variants.tokengs | tokens.yaml
tiny/locus.yaml | tiny/locuss.yaml | :2: base | locuss.yaml
VARIANT | tiny/locus.yaml | :5: variants.flat | `full`
VARIANT | {views: {inputs: 3}} | :5: variants.flat | `differs: [views.inputs]`
differs: [ | differs: [views.inputs,  | differs | `views.inputs`
differs: [losses.anchor_visibility] |  | :6: variants.tokengs | anchor_visibility]`
budget: | evaluations: {more: {model: {width: 8}}}\nbudget: | :8: evaluations.more.model | only set
"""
"""What is written, what is written instead, where that is told, and a word of it."""


def test_what_is_wrong_is_told_with_its_line_before_anything_trains(tmp_path):
    many = "".join(f"  v{n}:\n" for n in range(198))
    for row in WRONG.replace("VARIANT", VARIANT).strip("\n").splitlines():
        written, instead, place, word = row.replace(r"\n", "\n").replace("MANY", many).split(" | ")
        assert SOUND.count(written) == 1, written
        with pytest.raises(RecipeError) as caught:
            composed(read(tmp_path, SOUND.replace(written, instead)))
        text = str(caught.value)
        assert text.startswith("1 problem in the study")
        assert place in text
        assert word in text


def study_with_indices(folder):
    folder.mkdir()
    for name in ("2views.json", "3views.json"):
        shutil.copy(RECIPES / "studies/rooms" / name, folder)
    judged = """overlay: {evaluation: {index: 2views.json}}
evaluations: {more: {evaluation: {index: 3views.json}}}
"""
    return read(folder, SOUND + judged)


def test_a_study_that_was_moved_knows_its_runs_by_what_the_index_holds(tmp_path):
    """Wherever the index lies now; another index is refused, also under the old name."""
    out, old, new = (tmp_path / name for name in ("out", "old", "new"))
    plan = planned(study_with_indices(old), out)
    write_plan(plan)
    for name in plan.evaluations:
        results = run_of(out, "flat", 0).evaluation(name)
        results.mkdir(parents=True)
        index = read_json(old / f"{3 if name else 2}views.json")
        write_json(results / "protocol.json", {"views": {"index": index}})
    shutil.rmtree(old)
    study = study_with_indices(new)
    write_plan(planned(study, out))
    assert resolve(recipe_file(out, "flat")).evaluation.index == str(new / "2views.json")
    assert str(new / "3views.json") in recipe_file(out, "flat", "more").read_text()
    for file, remedy in (("2views.json", "another --out"), ("3views.json", "`more` another name")):
        text = (new / file).read_text()
        index = json.loads(text)
        index.popitem()
        write_json(new / file, index)
        must_refuse(f"{file}.*{remedy}", planned, study, out)
        (new / file).write_text(text)


def test_variants_judged_by_the_same_index_under_two_names_are_alike(tmp_path):
    shutil.copy(RECIPES / "studies/rooms/2views.json", tmp_path / "again.json")

    def judged_by(name):
        text = f"""study: 1
base: {RECIPES}/tiny/locus.yaml
variants:
  full: {{evaluation: {{index: {tmp_path}/again.json}}}}
  flat:
    model: {{decoder: {{cross_attention: {{type: qgs/content}}}}}}
    evaluation: {{index: {RECIPES}/studies/rooms/{name}}}
reference: full
budget: {{steps: 200}}
"""
        return read(tmp_path, text)

    composed(judged_by("2views.json"))
    must_refuse("index", composed, judged_by("3views.json"), kind=RecipeError)


def test_a_metric_that_cannot_be_measured_here_is_refused_before_training(tmp_path):
    metrics = "{plugins: [lpips], metrics: {lpips: {type: lpips/vgg16}}}"
    text = SOUND + f"metric: lpips\noverlay: {metrics}\n"
    must_refuse("lpips", planned, read(tmp_path, text), tmp_path / "out", kind=OptionError)


def test_hypotheses_are_sums_that_weigh_alike():
    terms, sign = parsed("a@noisy - a > b@noisy - b", "ab", ["noisy"])
    assert sign == 1
    assert terms == {("a", "noisy"): 1, ("a", ""): -1, ("b", "noisy"): -1, ("b", ""): 1}
    for text in ("a", "a < b < c", "a - b < c", "a < a", "a b < c + c", "a@x < b", "< b"):
        with pytest.raises(OptionError):
            parsed(text, "abc", ["noisy"])


def test_the_studies_that_are_shown_can_be_copied(tmp_path):
    """As they are, but for the recipe that docs/studies.md calls the reader's own."""
    lines = [line.rstrip() for line in done("study --help").output.splitlines()]
    example = re.search(r"^ {5}study: 1\n( {5}.*\n)+", "\n".join(lines), re.MULTILINE)
    shown = {"help": [textwrap.dedent(example[0])]}
    (tmp_path / "mine.yaml").write_text("recipe: 1\nextends: tiny/locus.yaml\nmodel: {width: 96}\n")
    for file in ("plugins/research/src/qgs_research/studies/README.md", "docs/studies.md"):
        page = (RECIPES.parent / file).read_text()
        shown[file] = re.findall(r"```\w+\n(study: 1\n.*?)```", page, re.DOTALL)
    for place, texts in shown.items():
        assert len(texts) == 1, place
        plan = planned(read(tmp_path, texts[0]), tmp_path / place)
        assert len(plan.runs) == 3 * len(plan.study.variants) >= 6, place
