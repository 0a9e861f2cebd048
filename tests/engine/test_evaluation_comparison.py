"""Paired comparisons of results."""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from qgs.contracts import Column
from qgs.engine.comparison import (
    compare,
    crossed_error,
    crossed_interval,
    paired_interval,
    t_quantile,
)
from qgs.engine.protocol import Protocol
from qgs.engine.results import StoredResults, read_results

COLUMNS = {"psnr": Column("PSNR", "higher", 2), "lpips": Column("LPIPS", "lower")}


def results(name: str, protocol: str = "rooms", **psnr: float) -> StoredResults:
    scenes = {scene: {"model_psnr": v, "model_lpips": v / 100} for scene, v in psnr.items()}
    judged_by = Protocol(protocol, {"format": 1, "views": protocol})
    frames = dict.fromkeys(scenes, ("0 3", "1 2"))
    return StoredResults(name, judged_by, COLUMNS, scenes, frames, len(scenes))


def test_the_interval_is_that_of_scipy() -> None:
    bootstrap = pytest.importorskip("scipy.stats").bootstrap
    differences = np.random.default_rng(1).normal(0.3, 1.0, 60)
    expected = bootstrap((differences,), np.mean, method="percentile", n_resamples=10_000, rng=0)
    found = paired_interval(differences)
    assert found == pytest.approx(tuple(expected.confidence_interval), abs=0.02)
    assert found == paired_interval(differences.copy())


def test_the_interval_is_none_for_one_scene() -> None:
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
    text = compare([first, second]).markdown()
    assert "1 scenes only in first, left out: only" in text
    assert "2 scenes only in second, left out: other, another" in text


def test_the_first_is_compared_with_each_of_the_others() -> None:
    values = {"x": 3.0, "y": 2.0, "z": 5.0}
    pairs = compare([results(name, a=value, b=value) for name, value in values.items()]).pairs
    found = [(p.first.name, p.second.name, p.differences[0].difference) for p in pairs]
    assert found == [("x", "y", 1.0), ("x", "z", -2.0)]


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(ValueError, match="two or more different results"):
        compare([results("x", a=1.0), results("x", a=1.0)])
    with pytest.raises(ValueError, match="x and y have no scene in common"):
        compare([results("x", a=1.0), results("y", b=1.0)])
    rooms, halls = results("x", a=1.0), results("y", "halls", a=2.0)
    with pytest.raises(ValueError, match=r"x was judged by rooms .*y by halls .*differ in views:"):
        compare([rooms, halls])
    (pair,) = compare([rooms, halls], across_protocols=True).pairs
    assert not pair.record()["same_protocol"]
    assert pair.differences[0].low is None


def test_scenes_judged_on_other_frames_are_refused_although_protocols_agree() -> None:
    first, second = results("x", a=1.0, b=2.0), results("y", a=1.0, b=2.0)
    moved = replace(second, frames={**second.frames, "b": ("0 4", "1 2")})
    with pytest.raises(ValueError, match=r"judged 1 scenes on different frames, .* agree: b"):
        compare([first, moved])
    text = compare([first, moved], across_protocols=True).markdown()
    assert "1 scenes judged on different frames: b" in text


def test_incomplete_results_say_so_in_one_line_with_the_count() -> None:
    first, second = (
        replace(results(name, a=1.0, b=2.0), wanted=3, missing=["c"], null=["d"]) for name in "xy"
    )
    text = compare([first, second]).markdown()
    assert "x against y, 2 of 3 scenes (missing: c)" in text
    for name in "xy":
        assert f"{name} is incomplete: no score of c" in text
    assert "null entries of the index, not judged (1): d" in text
    complete = compare([results("x", a=1.0), results("y", a=2.0)]).markdown()
    assert "x against y, 1 scene**" in complete


def test_tables_fit_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    pair = [results("x", a=10.0, b=22.5), results("y", a=12.0, b=21.0)]
    compare(pair).show(Console(width=80))
    out = capsys.readouterr().out
    assert "[-2.000, +1.500]" in out
    assert "1 : 1" in out


def test_results_nested_too_deeply_are_told(tmp_path: Path) -> None:
    for name in ("summary", "protocol"):
        (tmp_path / f"{name}.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"cannot be read \(RecursionError"):
        read_results(tmp_path)


def test_folders_without_results_are_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no results in"):
        read_results(tmp_path)
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(ValueError, match="evaluate again with `qgs eval`"):
        read_results(tmp_path)


def training(name: str, recipe: str, seed: int, step: int = 100, **psnr: float) -> StoredResults:
    known = {"recipe": recipe, "seed": seed, "step": step, "budget": "60 s"}
    return replace(results(name, **psnr), **known)


def test_trainings_of_one_recipe_are_one_side_paired_by_seed() -> None:
    ours = [training(f"r/a/{s}", "A", s, a=10.0 + s, b=12.0 - s) for s in range(3)]
    theirs = [training(f"r/b/{s}", "B", s, 190, a=9.0 + s, b=11.5 - s) for s in (1, 0)]
    (pair,) = compare([*ours, *theirs]).pairs
    psnr = pair.differences[0]
    assert (psnr.trainings, psnr.scenes, psnr.difference) == (2, 2, pytest.approx(0.75))
    text = compare([*ours, *theirs]).markdown()
    assert "r/a against r/b" in text
    assert re.search(r"\| metric +\| +a \| +b \| +difference", text)
    assert "interval: 2 trainings a side and scenes, both random" in text
    assert "r/a: 100 steps of a budget of 60 s, seed 0, 1, 2" in text
    assert "r/b: 190 steps of a budget of 60 s, seed 1, 0" in text
    assert "r/a: seed 2 left out, nothing to pair with" in text
    assert "r/b: seed" not in text
    assert "unequal training: 1.90 times the steps of the other" in text


def test_one_training_a_side_says_nothing_of_training() -> None:
    pair = [training("x", "A", 0, a=1.0, b=2.5), training("y", "B", 0, a=2.0, b=2.0)]
    assert "one training a side: says nothing of training" in compare(pair).markdown()


def test_several_trainings_against_one_say_nothing_of_training() -> None:
    ours = [training(f"r/a/{s}", "A", s, a=10.0 + s, b=12.0 - s) for s in range(3)]
    text = compare([*ours, training("r/b", "B", 0, a=9.0, b=11.0)]).markdown()
    assert "3 against 1 trainings: says nothing of training" in text
    assert "left out" not in text


def test_seeds_whose_index_was_moved_between_them_are_one_side(tmp_path: Path) -> None:
    """The protocol holds what the index says; where it lay is no matter."""
    summary = {
        "protocol": {"name": "x"},
        "columns": {"psnr": {"heading": "PSNR", "better": "higher"}},
        "step": 9,
    }
    summary |= {"missing": {}, "null_entries": [], "scenes_in_protocol": 1}
    for name in ("a0", "a1", "b0", "b1"):
        folder = tmp_path / name / "evaluation"
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text(json.dumps(summary))
        (folder / "protocol.json").write_text("{}")
        row = f"s,0,1,{10.0 + ord(name[0])},"
        text = f"scene,input_frames,target_frames,model_psnr,problem\n{row}\n"
        (folder / "scenes.csv").write_text(text)
        recipe = f"seed: {name[1]}\nmodel: {name[0]}\ntraining: {{steps: 9, seconds: null}}\n"
        recipe += f"evaluation: {{index: /in/{name}.json}}\n"
        (tmp_path / name / "recipe.yaml").write_text(recipe)
    (pair,) = compare([read_results(folder) for folder in sorted(tmp_path.iterdir())]).pairs
    assert [len(side.runs) for side in (pair.first, pair.second)] == [2, 2]
    assert pair.differences[0].low is None
    assert "one scene is too few for an interval" in [*pair.notes()]


def test_seeds_of_one_recipe_alone_are_compared_with_each_other() -> None:
    pair = [training(name, "A", s, a=1.0 + s, b=2.0) for s, name in enumerate("xy")]
    (found,) = compare(pair).pairs
    assert (found.first.name, found.second.name) == ("x", "y")


def test_t_quantiles_are_those_of_scipy() -> None:
    stats = pytest.importorskip("scipy.stats")
    for freedom in (1.0, 2.0, 3.7, 62.0, 1e4):
        assert t_quantile(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-4)


VARIANCES = {"scenes": (0.1, 1.0, 0.1), "trainings": (1.0, 0.1, 0.1), "noise": (0.0, 0.0, 1.0)}
"""Deviations of trainings, of scenes and of the rest, by which of them is the largest."""


@cache
def t_quantiles() -> tuple[np.ndarray, list[float]]:
    """Degrees of freedom, and the quantile of each."""
    grid = np.geomspace(1.0, 1e4, 200)
    return grid, [t_quantile(freedom) for freedom in grid]


@pytest.mark.parametrize("most", VARIANCES)
@pytest.mark.parametrize(("trainings", "scenes"), [(3, 3), (3, 5), (3, 32), (5, 5)])
def test_the_interval_over_trainings_and_scenes_holds_the_truth(
    trainings: int, scenes: int, most: str
) -> None:
    """In 95 of 100 cases, whatever varies more, at few scenes too; and it is no wider than needed.

    That over scenes alone does not, where trainings differ.
    """
    rng, count, shape = np.random.default_rng(0), 4000, (trainings, scenes)
    of_training, of_scene, rest = VARIANCES[most]
    values = rng.normal(0, of_training, (count, trainings, 1))
    values = values + rng.normal(0, of_scene, (count, 1, scenes))
    values = values + rng.normal(0, rest, (count, *shape))
    error, freedom = crossed_error(values)
    half = np.interp(freedom, *t_quantiles()) * error
    for one, width in zip(values[:9], half, strict=False):
        low, high = crossed_interval(one) or (0.0, 0.0)
        assert high - low == pytest.approx(2 * width, rel=1e-2)
    hits = np.abs(values.mean((1, 2))) <= half
    assert 0.93 <= hits.mean() <= 0.985
    truth = of_training**2 / trainings + of_scene**2 / scenes + rest**2 / (trainings * scenes)
    least = t_quantile(min(trainings, scenes) - 1)
    assert np.median(half) <= 1.25 * least * truth**0.5
    if most == "trainings":
        alone = values.mean(1).std(1, ddof=1) / scenes**0.5 * t_quantile(scenes - 1)
        assert (np.abs(values.mean((1, 2))) <= alone).mean() < 0.7


def test_scores_that_do_not_vary_leave_no_doubt_and_one_of_a_kind_says_nothing() -> None:
    assert crossed_interval(np.full((3, 4), 2.0)) == (2.0, 2.0)
    assert crossed_interval(np.ones((1, 4))) is None
    assert crossed_interval(np.array([[0.0], [1.0], [2.0]])) is None


def test_a_surer_interval_is_wider() -> None:
    stats = pytest.importorskip("scipy.stats")
    assert t_quantile(2.0, 0.995) == pytest.approx(stats.t.ppf(0.9975, 2.0), rel=1e-4)
    values = np.random.default_rng(0).normal(size=(3, 8))
    usual, sure = crossed_interval(values), crossed_interval(values, 0.99)
    assert usual
    assert sure
    assert sure[0] < usual[0] < usual[1] < sure[1]
