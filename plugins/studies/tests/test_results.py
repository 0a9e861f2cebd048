"""Tables and verdicts of made-up scores, held against numbers made by hand."""

import csv
import json
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import fill_evidence
import numpy as np
import pytest
from qgs_studies.figures import write_figures
from qgs_studies.intervals import crossed_interval
from qgs_studies.output import latex, markdown, table_rows, write_files
from qgs_studies.plan import Plan, run_of
from qgs_studies.results import Results
from qgs_studies.study import read_study

Score = Callable[[str, str, int, int], float]
"""Of a variant by an evaluation with a seed on a scene."""

STUDY = """study: 1
variants: {full: tiny/locus.yaml, less: tiny/locus.yaml, other: tiny/locus.yaml}
reference: full
seeds: [0, 1, 2]
budget: {steps: 9}
evaluations: {noisy: {views: {pose_noise: 1.0}}}
hypotheses:
  - less < full
  - other > full
  - {claim: less@noisy - less < full@noisy - full, note: degrades more}
published: {full: 24.0, less: 23.0, other: 22.0}
"""
COLUMNS = {"psnr": {"heading": "PSNR", "better": "higher", "digits": 2, "unit": "dB"}}


def csv_rows(found: Results) -> list[dict[str, str]]:
    write_files(found)
    with (found.plan.folder / "table.csv").open() as file:
        return [*csv.DictReader(file)]


NEAREST = 15.5
"""PSNR of the nearest input in every scene."""


def write_run(folder: Path, values: Mapping[str, float], step: int, views: str = "") -> None:
    folder.mkdir(parents=True)
    rows = [f"{scene},0 3,1 2,{value!r},{NEAREST}," for scene, value in values.items()]
    head = "scene,input_frames,target_frames,model_psnr,nearest_input_psnr,problem"
    (folder / "scenes.csv").write_text("\n".join([head, *rows]) + "\n")
    summary = {"protocol": {"name": "made up"}, "columns": COLUMNS, "step": step, "missing": {}}
    summary |= {"scenes_in_protocol": len(values), "null_entries": []}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "protocol.json").write_text(json.dumps({"views": {"drawn": views}}))


def results(
    folder: Path,
    score: Score,
    seeds: int = 3,
    scenes: int = 8,
    views: Callable[[str, str], str] = lambda variant, evaluation: evaluation,
    text: str = STUDY,
) -> Results:
    """Of the study above: `seeds` of the three are there. views: what their protocol says."""
    (folder / "study.yaml").write_text(text)
    study = read_study(folder / "study.yaml")
    recipes: Any = dict.fromkeys(study.variants, SimpleNamespace())
    plan = Plan(study, folder, recipes)
    for variant in recipes:
        for seed in range(seeds):
            for name in plan.evaluations:
                values = {f"s{n}": score(variant, name, seed, n) for n in range(scenes)}
                where = run_of(folder, variant, seed).evaluation(name)
                write_run(where, values, 9, views(variant, name))
    return Results(plan)


OFFSETS = {"full": 0.0, "less": -1.0, "other": 0.0}


def simple(variant: str, evaluation: str, seed: int, scene: int) -> float:
    """Clear but for `other`, with noise of a tenth that is the same each time."""
    rng = np.random.default_rng([*f"{variant}{evaluation}".encode(), seed, scene])
    noise = 0.5 * bool(evaluation) * (2 if variant == "less" else 1)
    return 20.0 + OFFSETS[variant] - noise + scene + 0.1 * float(rng.normal())


def test_numbers_are_those_of_the_definition(tmp_path: Path) -> None:
    found = results(tmp_path, simple)
    table = np.array(
        [[[simple(v, "", s, n) for n in range(8)] for s in range(3)] for v in ("less", "full")]
    )
    row = next(row for row in found.rows() if row.variant == "less")
    score, apart = row.scores["psnr"], row.differences["psnr"]
    assert score.mean == pytest.approx(table[0].mean())
    assert score.deviation == pytest.approx(table[0].mean(1).std(ddof=1))
    assert apart.mean == pytest.approx((table[0] - table[1]).mean())
    assert (apart.low, apart.high) == pytest.approx(crossed_interval(table[0] - table[1]))
    assert apart.covers == "3 seeds x 8 scenes"
    contrast = found.judgements()[2].estimate
    assert contrast
    assert contrast.mean == pytest.approx(-0.5, abs=0.15)


def test_trainings_that_failed_are_in_the_answer(tmp_path: Path) -> None:
    plan = results(tmp_path, simple).plan
    for seed in range(3):
        run = run_of(tmp_path, "other", seed)
        shutil.rmtree(run.folder)
        run.failure.write_text("CollapseError: training collapsed at step 7: it\nLikely causes")
    found = Results(plan)
    assert found.answer().startswith("No: less is worse than full, PSNR ")
    assert found.answer().endswith("Left out: 3 of 3 trainings of other failed (CollapseError).")
    assert "other seed 0 failed: CollapseError: training collapsed at step 7: it" in found.notes()


@pytest.mark.parametrize(
    ("offset", "answer", "verdict"),
    [
        (2.0, r"Yes: other, the best of 2, is better than full, PSNR \+2.0", "seen"),
        (
            0.0,
            "Undecided: other cannot be told from full, .*; worse, each at 95 %: less.",
            "undecided",
        ),
        (-2.0, "No: all 2 are worse; the nearest, less, is worse than full", "contradicted"),
    ],
)
def test_verdicts_and_the_answer(tmp_path: Path, offset: float, answer: str, verdict: str) -> None:
    def score(variant: str, evaluation: str, seed: int, scene: int) -> float:
        return simple(variant, evaluation, seed, scene) + offset * (variant == "other")

    found = results(tmp_path, score)
    assert re.match(answer, found.answer())
    first, other, noisy = (judgement.verdict for judgement in found.judgements())
    assert (first, noisy) == ("seen", "seen")
    assert other == verdict
    assert found.rank_correlation()[0] is None, "of three variants any order is likely"


def test_seeds_that_disagree_leave_it_open_however_sure_the_scenes_are(tmp_path: Path) -> None:
    """Of one seed alone, scenes would call it seen."""

    def score(variant: str, evaluation: str, seed: int, scene: int) -> float:
        lead = {0: 1.0, 1: -0.6, 2: 0.7}[seed] * (variant == "other")
        return simple(variant, evaluation, seed, scene) + lead

    found = results(tmp_path, score)
    assert found.judgements()[1].verdict == "undecided"
    (tmp_path / "one").mkdir()
    alone = results(tmp_path / "one", score, seeds=1)
    judged = alone.judgements()[1]
    assert judged.estimate
    assert judged.estimate.low
    assert judged.estimate.low > 0
    assert (judged.verdict, judged.reason) == ("undecided", "one training a side")
    assert alone.answer().startswith("Not known: other, the best of 2, has PSNR +")
    assert "says nothing of training" in alone.answer()
    assert "6 of 9 runs are missing: full seed 1" in "\n".join(alone.notes())


def test_files_hold_the_same_numbers(tmp_path: Path) -> None:
    found = results(tmp_path, simple)
    rows = {(r["evaluation"], r["variant"]): r for r in csv_rows(found)}
    write_figures(found)
    record = json.loads((tmp_path / "results.json").read_text())
    assert len(rows) == len(record["table"]) == 6
    for row in record["table"]:
        assert float(rows[row["evaluation"], row["variant"]]["mean"]) == row["mean"]
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + 3 * 3 * 2
    assert "degrades more" in markdown(found)
    assert latex(found).count(r"\toprule") == 2
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {f"values{n}.{s}" for n in ("", "-noisy") for s in ("pdf", "png")}


def test_numbers_of_unlike_protocols_are_not_compared(tmp_path: Path) -> None:
    """The answer is by the first evaluation that all share, the table shows no difference."""

    def views(variant: str, evaluation: str) -> str:
        return evaluation or ("six" if variant == "other" else "two")

    found = results(tmp_path, simple, views=views)
    first, cells = found.answer(), {row[0]: row[3:6] for row in table_rows(found)[1:]}
    assert first.startswith("Undecided: other cannot be told from full, PSNR in the evaluation `no")
    assert cells["full"] == ["reference", "–", "–"]
    assert cells["other"] == ["–", "–", "–"]
    assert cells["less"][0].startswith("-0.9")
    assert any("protocols differ" in note and "other" in note for note in found.notes())
    reasons = [j.reason for j in found.judgements()]
    assert reasons == ["", "the interval holds 0, judged by unlike protocols", ""]
    record = next(r for r in csv_rows(found) if (r["evaluation"], r["variant"]) == ("", "other"))
    assert (record["difference"], record["low"]) == ("", "")


def lead(size: float, wobble: float) -> Score:
    """Of `other`: by so much, more or less from seed to seed."""

    def score(variant: str, evaluation: str, seed: int, scene: int) -> float:
        other = (size + (0.0, wobble, -wobble)[seed]) * (variant == "other")
        return simple(variant, evaluation, seed, scene) + other

    return score


def test_the_best_of_several_is_better_when_chance_has_several_tries(tmp_path: Path) -> None:
    """Its own interval at 95 % lies above 0, that of the best of two does not."""
    found = results(tmp_path, lead(0.5, 0.18))
    apart = found.rows()[2].differences["psnr"]
    assert apart.low is not None
    assert apart.low > 0
    assert found.answer().startswith("Undecided: other cannot be told from full, PSNR +0.5")
    assert "97.5 % interval [-" in found.answer()
    assert "corrected for the best of 2" in found.answer()
    (tmp_path / "two").mkdir()
    alone = STUDY.replace(", other: tiny/locus.yaml}", "}").replace("  - other > full\n", "")
    alone = alone.replace(", other: 22.0}", "}").replace("less", "other")
    two = results(tmp_path / "two", lead(0.5, 0.18), text=alone)
    assert two.answer().startswith("Yes: other is better than full, PSNR +0.")
    assert "(95 % interval [+" in two.answer()


def test_a_variant_without_the_metric_is_a_row_of_dashes(tmp_path: Path) -> None:
    plan = results(tmp_path, simple).plan
    for seed in range(3):
        file = run_of(tmp_path, "less", seed).folder / "evaluation" / "scenes.csv"
        file.write_text(re.sub(r"(,1 2),[^,]*", r"\1,", file.read_text()))
    found = Results(plan)
    row = next(row for row in table_rows(found) if row[0] == "less")
    assert row[1:6] == ["–"] * 5
    write_files(found)
    assert "\n,less,0,\n" in (tmp_path / "runs.csv").read_text()


def test_published_values_are_shown_and_ranked_from_five_variants_on(tmp_path: Path) -> None:
    names = ("full", "less", "other", "four", "five")
    text = STUDY.replace("{full:", "{four: tiny/locus.yaml, five: tiny/locus.yaml, full:", 1)
    text = text.replace("other: 22.0", "other: 22.0, four: 21.5, five: 21.0")

    def score(variant: str, evaluation: str, seed: int, scene: int) -> float:
        return 20.0 - names.index(variant) + 0.01 * scene + 0.001 * seed

    found = results(tmp_path, score, text=text)
    assert found.rank_correlation() == (pytest.approx(1.0), 5)
    head, *rows = table_rows(found)
    shown = {row[0]: row[head.index("published")] for row in rows}
    assert (shown["full"], shown["four"]) == ("24.000", "21.500")


def test_the_evidence_page_takes_studies_of_one_seed(tmp_path: Path) -> None:
    write_files(results(tmp_path, simple, seeds=1))
    assert "| noisy | 23.01 (–) |" in fill_evidence.page_of(tmp_path)
