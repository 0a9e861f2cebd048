"""`qgs bench` as a user types it."""

import json
import re
from pathlib import Path

import pytest
from commands import SMALL, run_qgs, sets
from typer.testing import Result

RECIPES = Path(__file__).parents[3] / "recipes"
TOKENGS, LOCUS = RECIPES / "tiny/tokengs.yaml", RECIPES / "tiny/locus.yaml"


def bench(*words: str | Path) -> Result:
    small = ["--size", "16x24", "--rounds", "3", "--warmup", "1", "--device", "cpu"]
    return run_qgs("bench", *words, *small, *sets())


@pytest.mark.slow
def test_tokengs_against_locusgs(tmp_path: Path) -> None:
    file = tmp_path / "reports/bench.json"
    result = bench(TOKENGS, LOCUS, "--step", "--memory", "--views", "3", "--json", file)
    assert result.exit_code == 0, result.output
    report = json.loads(file.read_text())
    tokengs, locus = report["recipes"]
    assert [tokengs["recipe"], locus["recipe"]] == [str(TOKENGS), str(LOCUS)]
    assert (report["overrides"], report["rounds"], report["warmup"]) == ([*SMALL], 3, 1)
    assert report["machine"].keys() >= {"device", "processor", "threads", "torch"}
    for recipe in (tokengs, locus):
        assert (recipe["views"], recipe["size"], recipe["precision"]) == (3, [16, 24], "float32")
        assert recipe["gaussians"] == 8 * 8
        assert recipe["parameters"]["weight_bytes"] == 4 * recipe["parameters"]["count"]
        assert list(recipe["seconds"]) == list(recipe["memory"]) == ["forward", "step"]
        assert all(m["peak_bytes"] > m["idle_bytes"] > 0 for m in recipe["memory"].values())
        assert all(len(times["samples"]) == 3 for times in recipe["seconds"].values())
    assert tokengs["seconds"]["step"]["ratio"]["median"] == tokengs["memory"]["step"]["ratio"] == 1
    forward = [recipe["seconds"]["forward"]["samples"] for recipe in (tokengs, locus)]
    paired = sorted(ours / theirs for theirs, ours in zip(*forward, strict=True))
    assert locus["seconds"]["forward"]["ratio"]["median"] == paired[1]
    assert f"{locus['parameters']['count']:,}" in result.output
    assert re.search(r"tokengs +│ 3 x 16 x 24", result.output)


def test_a_model_whose_gaussians_depend_on_the_views() -> None:
    words = ("--size", "16x24", "--rounds", "2", "--warmup", "0", "--device", "cpu")
    result = run_qgs("bench", RECIPES / "tiny/gslrm.yaml", *words, "--set", "model.width=16")
    assert result.exit_code == 0, result.output
    assert re.search(r"gslrm +│ 2 x 16 x 24 +│ by the views", result.output)


def test_a_report_replaces_a_report_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    assert bench(TOKENGS, "--json", file).exit_code == 0
    assert bench(LOCUS, "--renderer", "--json", file).exit_code == 0
    (recipe,) = json.loads(file.read_text())["recipes"]
    assert (recipe["recipe"], list(recipe["seconds"])) == (str(LOCUS), ["forward", "render"])
    notes = tmp_path / "notes.json"
    notes.write_text('{"mine": true}')
    refused = bench(TOKENGS, "--json", notes)
    assert isinstance(refused.exception, FileExistsError)
    assert notes.read_text() == '{"mine": true}'


@pytest.mark.parametrize(
    "words",
    [["--size", "16"], ["--size", "16x0"], ["--size", "15x24"], ["--precision", "fp16"]],
)
def test_mistakes(words: list[str]) -> None:
    result = run_qgs("bench", TOKENGS, *words, "--device", "cpu")
    assert isinstance(result.exception, ValueError)
    assert words[1].partition("x")[0] in str(result.exception)
