"""Paired comparisons of results, and their intervals."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import SMALL, run_qgs
from qgs_studies.comparison import compare
from qgs_studies.intervals import crossed_error, crossed_interval, paired_interval
from qgs_studies.stored import StoredResults
from scipy import stats

import qgs
from qgs.contracts import Column
from qgs.engine.protocol import Protocol

RECIPES = Path(__file__).parents[3] / "recipes" / "tiny"
COLUMNS = {"psnr": Column("PSNR", "higher", 2), "lpips": Column("LPIPS", "lower")}


def results(name: str, protocol: str = "rooms", **psnr: float) -> StoredResults:
    scenes = {scene: {"model_psnr": v, "model_lpips": v / 100} for scene, v in psnr.items()}
    content = Protocol(protocol, {"format": 1, "views": protocol})
    frames = dict.fromkeys(scenes, ("0 3", "1 2"))
    return StoredResults(name, content, COLUMNS, scenes, frames, len(scenes))


def training(name: str, recipe: str, seed: int, step: int = 100, **psnr: float) -> StoredResults:
    known = {"recipe": recipe, "seed": seed, "step": step, "budget": "60 s"}
    return replace(results(name, **psnr), **known)


def test_the_bootstrap_interval_is_that_of_scipy() -> None:
    differences = np.random.default_rng(1).normal(0.3, 1.0, 60)
    options = {"method": "percentile", "n_resamples": 10_000}
    expected = stats.bootstrap((differences,), np.mean, **options).confidence_interval
    found = paired_interval(differences)
    assert found == pytest.approx(tuple(expected), abs=0.02)
    assert found == paired_interval(differences.copy())
    assert paired_interval(np.ones(1)) is None


def test_scenes_pair_by_name_and_lower_is_better_for_lpips() -> None:
    first = results("first", a=10.0, b=12.0, c=11.0, only=50.0)
    second = results("second", c=11.0, b=10.0, a=9.0, other=1.0, another=2.0)
    (pair,) = compare([first, second]).pairs
    psnr, lpips = pair.differences
    assert (psnr.first, psnr.second, psnr.scenes) == (11.0, 10.0, 3)
    assert psnr.difference == pytest.approx(1.0)
    assert (psnr.wins, psnr.losses) == (2, 0)
    assert (lpips.wins, lpips.losses) == (0, 2)
    record = pair.record()
    assert (record["only_first"], record["only_second"]) == (["only"], ["other", "another"])


def test_the_first_is_compared_with_each_of_the_others() -> None:
    values = {"x": 3.0, "y": 2.0, "z": 5.0}
    pairs = compare([results(name, a=value, b=value) for name, value in values.items()]).pairs
    found = [(p.first.name, p.second.name, p.differences[0].difference) for p in pairs]
    assert found == [("x", "y", 1.0), ("x", "z", -2.0)]
    seeds = [training(name, "A", s, a=1.0 + s, b=2.0) for s, name in enumerate("xy")]
    (alone,) = compare(seeds).pairs
    assert (alone.first.name, alone.second.name) == ("x", "y"), "seeds of one recipe alone"


def test_what_cannot_be_compared_is_refused() -> None:
    for pair in ([results("x", a=1.0)] * 2, [results("x", a=1.0), results("y", b=1.0)]):
        with pytest.raises(ValueError, match="x"):
            compare(pair)
    first, second = results("x", a=1.0, b=2.0), results("y", a=1.0, b=2.0)
    halls = replace(second, protocol=results("y", "halls").protocol)
    moved = replace(second, frames={**second.frames, "b": ("0 4", "1 2")})
    for other, key in ((halls, "same_protocol"), (moved, "other_frames")):
        with pytest.raises(ValueError, match="across-protocols"):
            compare([first, other])
        record = compare([first, other], across_protocols=True).pairs[0].record()
        assert record[key] == {"same_protocol": False, "other_frames": ["b"]}[key]


def test_trainings_of_one_recipe_are_one_side_paired_by_seed() -> None:
    ours = [training(f"r/a/{s}", "A", s, a=10.0 + s, b=12.0 - s) for s in range(3)]
    theirs = [training(f"r/b/{s}", "B", s, 190, a=9.0 + s, b=11.5 - s) for s in (1, 0)]
    (pair,) = compare([*ours, *theirs]).pairs
    psnr = pair.differences[0]
    assert (psnr.trainings, psnr.scenes, psnr.difference) == (2, 2, pytest.approx(0.75))
    assert (pair.first.name, pair.second.name) == ("r/a", "r/b")
    text = compare([*ours, *theirs]).markdown()
    assert "r/a: seed 2 left out" in text
    assert "1.90 times" in text


def test_two_runs_compare_scene_by_scene(tmp_path: Path) -> None:
    few = (*SMALL, "data.image_size=[16, 16]", "views.targets=1", "evaluation.scenes=2")
    runs = tmp_path / "locus", tmp_path / "tokengs"
    for run in runs:
        model = qgs.compose(RECIPES / f"{run.name}.yaml", overrides=few)
        qgs.save(model, run / "checkpoint.safetensors")
        assert run_qgs("eval", run).exit_code == 0
    result = run_qgs("compare", *runs, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    psnr = json.loads((tmp_path / "comparison.json").read_text())["pairs"][0]["differences"][0]
    summaries = [json.loads((run / "evaluation/summary.json").read_text()) for run in runs]
    means = [summary["model"]["psnr"] for summary in summaries]
    assert psnr["difference"] == pytest.approx(means[0] - means[1])
    assert psnr["low"] <= psnr["difference"] <= psnr["high"]
    assert psnr["wins"] + psnr["losses"] == psnr["scenes"] == 2


VARIANCES = {"scenes": (0.1, 1.0, 0.1), "trainings": (1.0, 0.1, 0.1), "noise": (0.0, 0.0, 1.0)}
"""Deviations of trainings, of scenes and of the rest, by which of them is the largest."""


@pytest.mark.parametrize("most", VARIANCES)
@pytest.mark.parametrize(("trainings", "scenes"), [(3, 3), (3, 5), (3, 32), (5, 5)])
def test_the_interval_over_trainings_and_scenes_holds_the_truth(
    trainings: int, scenes: int, most: str
) -> None:
    """In 95 of 100 cases, whichever varies more, also for few scenes; and no wider than needed."""
    rng, count, shape = np.random.default_rng(0), 4000, (trainings, scenes)
    of_training, of_scene, rest = VARIANCES[most]
    values = rng.normal(0, of_training, (count, trainings, 1))
    values = values + rng.normal(0, of_scene, (count, 1, scenes))
    values = values + rng.normal(0, rest, (count, *shape))
    error, freedom = crossed_error(values)
    half = stats.t.ppf(0.975, freedom) * error
    low, high = crossed_interval(values[0]) or (0.0, 0.0)
    assert high - low == pytest.approx(2 * half[0])
    assert 0.93 <= (np.abs(values.mean((1, 2))) <= half).mean() <= 0.985
    truth = of_training**2 / trainings + of_scene**2 / scenes + rest**2 / (trainings * scenes)
    assert np.median(half) <= 1.25 * stats.t.ppf(0.975, min(trainings, scenes) - 1) * truth**0.5


def test_an_interval_needs_two_of_each_and_widens_with_confidence() -> None:
    assert crossed_interval(np.full((3, 4), 2.0)) == (2.0, 2.0)
    assert crossed_interval(np.ones((1, 4))) is None
    assert crossed_interval(np.array([[0.0], [1.0], [2.0]])) is None
    values = np.random.default_rng(0).normal(size=(3, 8))
    usual, sure = crossed_interval(values), crossed_interval(values, 0.99)
    assert usual
    assert sure
    assert sure[0] < usual[0] < usual[1] < sure[1]
