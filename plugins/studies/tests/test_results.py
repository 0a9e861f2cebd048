"""Tables and verdicts of made-up scores, held against numbers made by hand."""

import csv
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from qgs_studies.figures import write_figures
from qgs_studies.output import latex, markdown, write_files
from qgs_studies.plan import Plan, run_of
from qgs_studies.results import Results
from qgs_studies.study import read_study

from qgs.engine.comparison import crossed_interval

Score = Callable[[str, str, int, int], float]
"""Of a variant by an evaluation with a seed on a scene."""

STUDY = """study: 1
variants: {full: x.yaml, less: x.yaml, other: x.yaml}
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


def write_run(folder: Path, values: Mapping[str, float], step: int) -> None:
    folder.mkdir(parents=True)
    rows = [f"{scene},0 3,1 2,{value!r}," for scene, value in values.items()]
    head = "scene,input_frames,target_frames,model_psnr,problem"
    (folder / "scenes.csv").write_text("\n".join([head, *rows]) + "\n")
    summary = {"protocol": {"name": "made up"}, "columns": COLUMNS, "step": step, "missing": {}}
    summary |= {"scenes_in_protocol": len(values), "null_entries": []}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "protocol.json").write_text("{}")


def results(folder: Path, score: Score, seeds: int = 3, scenes: int = 8) -> Results:
    """Of the study above: `seeds` of the three are there."""
    (folder / "study.yaml").write_text(STUDY)
    study = read_study(folder / "study.yaml")
    recipes: Any = dict.fromkeys(study.variants, SimpleNamespace())
    plan = Plan(study, folder, recipes)
    for variant in recipes:
        for seed in range(seeds):
            for name in plan.evaluations:
                values = {f"s{n}": score(variant, name, seed, n) for n in range(scenes)}
                write_run(run_of(folder, variant, seed).evaluation(name), values, 9)
    return Results(plan)


OFFSETS = {"full": 0.0, "less": -1.0, "other": 0.0}


def simple(variant: str, evaluation: str, seed: int, scene: int) -> float:
    """Clear but for `other`, with noise of a tenth that is the same each time."""
    rng = np.random.default_rng([*f"{variant}{evaluation}".encode(), seed, scene])
    noise = 0.5 * bool(evaluation) * (2 if variant == "less" else 1)
    return 20.0 + OFFSETS[variant] - noise + scene + 0.1 * float(rng.normal())


def test_verdicts_and_the_answer(tmp_path: Path) -> None:
    found = results(tmp_path, simple)
    verdicts = [j.verdict for j in found.judgements()]
    assert verdicts == ["seen", "undecided", "seen"]
    assert found.answer().startswith("Undecided: other cannot be told from full, PSNR ")
    assert "1 of 2 variants are worse" in found.answer()
    assert abs(found.rank_correlation() or 0) == pytest.approx(0.5)


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


@pytest.mark.parametrize(
    ("offset", "first", "verdict"),
    [
        (2.0, "Yes: other, the best of 2, is better than full, PSNR +2.0", "seen"),
        (
            -2.0,
            "No: all 2 are worse; the nearest, less, is worse than full, PSNR -",
            "contradicted",
        ),
    ],
)
def test_clear_answers(tmp_path: Path, offset: float, first: str, verdict: str) -> None:
    def score(variant: str, evaluation: str, seed: int, scene: int) -> float:
        return simple(variant, evaluation, seed, scene) + offset * (variant == "other")

    found = results(tmp_path, score)
    assert found.answer().startswith(first)
    assert found.judgements()[1].verdict == verdict


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
    write_files(found)
    write_figures(found)
    record = json.loads((tmp_path / "results.json").read_text())
    with (tmp_path / "table.csv").open() as file:
        rows = {(r["evaluation"], r["variant"]): r for r in csv.DictReader(file)}
    assert len(rows) == len(record["table"]) == 6
    for row in record["table"]:
        assert float(rows[row["evaluation"], row["variant"]]["mean"]) == row["mean"]
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 1 + 3 * 3 * 2
    text = markdown(found)
    assert "| less < full" in text
    assert "degrades more" in text
    assert "two-way variance" in text
    table = latex(found)
    assert r"less & 2" in table
    assert table.count(r"\toprule") == 2
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {f"values{n}.{s}" for n in ("", "-noisy") for s in ("pdf", "png")}
