"""Paired comparisons of results, and their intervals."""

from dataclasses import replace
from itertools import product

import numpy as np
from commands import done
from qgs_research.studies.scores import crossed_error, interval
from qgs_research.studies.stored import StoredResults
from qgs_research.studies.tables import compare, summary
from scipy import stats
from tables import assert_near, must_refuse, read_json

from qgs.contracts import Column
from qgs.evaluate.protocol import Protocol

COLUMNS = {"psnr": Column("PSNR", "higher", 2), "lpips": Column("LPIPS", "lower")}


def results(name, recipe="", seed=None, step=None, **psnr):
    """Of one training, with an LPIPS of PSNR / 100."""
    scenes = {scene: {"model_psnr": v, "model_lpips": v / 100} for scene, v in psnr.items()}
    protocol = Protocol("rooms", {"format": 1, "views": "rooms"})
    stored = StoredResults(name, protocol, COLUMNS, scenes, dict.fromkeys(scenes, ("0 3", "1 2")))
    return replace(stored, recipe=recipe, seed=seed, step=step)


def test_scenes_pair_by_name():
    first = results("first", c=11.0, b=10.0, a=9.0, other=1.0, another=2.0)
    scores = compare([first, results("second", a=10.0, b=12.0, c=11.0, only=50.0)])
    psnr, lpips = (scores.difference("second", metric) for metric in COLUMNS)
    assert_near(psnr.mean, 1.0)
    assert psnr.scenes == 3
    assert_near(lpips.mean, 0.01)
    assert "second: scenes not in both (3): another, only, other" in summary(scores).notes


def test_the_first_is_compared_with_each_of_the_others():
    three = [results(name, a=value, b=value) for name, value in zip("xyz", (3, 2, 5), strict=True)]
    seeds = [results(name, "A", s, 100, a=1.0 + s, b=2.0) for s, name in enumerate("xy")]
    # Or seeds of one recipe, each of which is then a side.
    for given, expected in ((three, {"y": -1, "z": 2}), (seeds, {"y": 0.5})):
        scores = compare(given)
        assert scores.reference == "x"
        assert {name: apart.mean for name, apart in scores.differences().items()} == expected


def test_what_cannot_be_compared_is_refused():
    first = results("x", a=1.0, b=2.0)
    second = results("y", a=1.0, b=2.0)
    for pair in ([first, first], [first, results("y", c=1.0)], [first]):
        must_refuse("x", compare, pair)
    halls = replace(second, protocol=Protocol("halls", {"format": 1, "views": "halls"}))
    moved = replace(second, frames={**second.frames, "b": ("0 4", "1 2")})
    notes = (
        "the protocols differ, so the scores do not measure the same thing",
        "scenes with different frames",
    )
    for other, note in zip((halls, moved), notes, strict=True):
        must_refuse("across-protocols", compare, [first, other])
        scores = compare([first, other], across_protocols=True)
        assert scores.difference("y", "psnr").mean == 0
        assert note in "\n".join(summary(scores).notes)


def test_trainings_of_one_recipe_are_one_side_paired_by_seed():
    ours = [results(f"r/a/{s}", "A", s, 100, a=10.0 + s, b=12.0) for s in range(3)]
    theirs = [results(f"r/b/{s}", "B", s, 190, a=9.0 + s, b=11.5) for s in (2, 0)]
    scores = compare([*ours, *theirs])
    apart = scores.difference("r/b/2 x 2 seeds", "psnr")
    assert apart.sample == "2 seeds x 2 scenes"
    assert_near(apart.mean, -0.75)
    assert scores.models() == ["r/a/0 x 3 seeds", "r/b/2 x 2 seeds"]
    assert "r/b/2 x 2 seeds: runs without a partner (1): r/a/1" in summary(scores).notes
    # Nothing is said of those that do not tell how they were trained.
    longer = [replace(run, trained={"steps": "190", "data": "rooms"}) for run in theirs]
    known = [replace(run, trained={"steps": "100", "data": "rooms"}) for run in ours]
    said = summary(compare([*known, *longer])).notes
    assert "r/b/2 x 2 seeds was trained unlike r/a/0 x 3 seeds: steps differ" in said
    alone = compare([*ours, results("r/c/7", "C", 7, a=9.0, b=11.0), results("d", a=1.0, b=1.0)])
    assert [apart.mean for apart in alone.differences().values()] == [-1.0, -10.0]


def test_two_runs_compare_scene_by_scene(tmp_path):
    runs = tmp_path / "locus-64", tmp_path / "tokengs-64"
    means = []
    for run in runs:
        folder = run / "evaluation"
        done(f"eval rooms/{run.name} --set evaluation.scenes=2 --out {folder}")
        means.append(read_json(folder / "summary.json")["model"]["psnr"])
    assert "95 % interval" in done(f"compare --out {tmp_path}", *runs).output
    table = read_json(tmp_path / "comparison.json")["table"]
    apart = next(row["difference"] for row in table if row["variant"] == str(runs[1]))
    assert_near(apart["mean"], means[1] - means[0])
    low, high = apart["interval"]
    assert low <= apart["mean"] <= high
    assert apart["scenes"] == 2
    assert "| PSNR ↑ |" in (tmp_path / "comparison.md").read_text()


def test_the_interval_over_trainings_and_scenes_holds_the_truth():
    """In 95 of 100 cases, whichever varies more, also for few scenes; and no wider than needed."""
    deviations = ((0.1, 1.0, 0.1), (1.0, 0.1, 0.1), (0, 0, 1.0))
    for case in product(deviations, ((3, 3), (3, 5), (3, 32), (5, 5))):
        rng = np.random.default_rng(0)
        count = 4000
        (of_training, of_scene, rest), (trainings, scenes) = case
        values = rng.normal(0, of_training, (count, trainings, 1))
        values = values + rng.normal(0, of_scene, (count, 1, scenes))
        values = values + rng.normal(0, rest, (count, trainings, scenes))
        error, freedom = crossed_error(values)
        half = stats.t.ppf(0.975, freedom) * error
        low, high = interval(values[0])
        assert_near(high - low, 2 * half[0])
        assert 0.93 <= (np.abs(values.mean((1, 2))) <= half).mean() <= 0.985, case
        truth = of_training**2 / trainings + of_scene**2 / scenes + rest**2 / (trainings * scenes)
        least = stats.t.ppf(0.975, min(trainings, scenes) - 1) * truth**0.5
        assert np.median(half) <= 1.25 * least, case
