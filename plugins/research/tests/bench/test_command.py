"""`qgs bench` as a user types it."""

import csv
import json
import re
from unittest.mock import Mock

import pytest
import yaml
from commands import run_qgs
from qgs_research.bench import output, predict, run, sweep
from qgs_research.bench.memory import Peak
from rich.console import Console

TOKENGS, LOCUS, GSLRM = "tiny/tokengs.yaml", "tiny/locus.yaml", "tiny/gslrm.yaml"
SETTINGS = ["model.width=16", "model.heads=2", "model.head.gaussians_per_query=2"]
SMALL = f"--size 16x24 --device cpu --rounds 3 --warmup 0 --set {' --set '.join(SETTINGS)}"


def bench(words):
    return run_qgs("bench", *f"{words} {SMALL}".split())


def test_recipes_are_compared_with_the_first(tmp_path, monkeypatch):
    peaks = iter([30, 60, 15, 15, 60, 90])
    monkeypatch.setattr(run, "peak_memory", lambda *_: Peak(2**20 * next(peaks), 2**20))
    everything = f"--step --memory --renderer --views 3 --json {tmp_path}/reports/bench.json"
    told = bench(f"{TOKENGS} {LOCUS} {GSLRM} {everything}").output
    report = json.loads((tmp_path / "reports/bench.json").read_text())
    assert report["machine"].keys() >= {"device", "processor", "threads", "torch"}
    assert (report["overrides"], report["rounds"], report["warmup"]) == (SETTINGS, 3, 0)
    recipes = report["recipes"]
    first, gaussians = recipes[0], {TOKENGS: 512, LOCUS: 512, GSLRM: None}
    assert {recipe["recipe"]: recipe["gaussians"] for recipe in recipes} == gaussians
    for recipe in recipes:
        count = recipe["parameters"]["count"]
        assert (recipe["views"], recipe["size"], recipe["precision"]) == (3, [16, 24], "float32")
        assert recipe["parameters"]["weight_bytes"] == 4 * count
        assert recipe["parameters"]["ratio"] == count / first["parameters"]["count"]
        assert f"{count:,}" in told
        assert list(recipe["seconds"]) == ["forward", "render", "step"]
        for kind, times in recipe["seconds"].items():
            pairs = zip(times["samples"], first["seconds"][kind]["samples"], strict=True)
            assert times["ratio"]["median"] == sorted(own / base for own, base in pairs)[1]
    ratios = [[kind["ratio"] for kind in recipe["memory"].values()] for recipe in recipes]
    assert ratios == [[1, 1], [0.5, 0.25], [2, 1.5]]
    assert re.search(
        r"(?s)tokengs +│ 3 x 16 x 24 +│ +512.*gslrm +│ 3 x 16 x 24 +│ by the views", told
    )


def test_a_report_replaces_a_report_and_nothing_else(tmp_path):
    file = tmp_path / "bench.json"
    output.write({"report": run.KIND}, file)
    assert bench(f"{TOKENGS} --json {file}").exit_code == 0
    assert json.loads(file.read_text())["recipes"]
    file.write_text('{"mine": true}')
    assert isinstance(bench(f"{TOKENGS} --json {file}").exception, FileExistsError)
    assert file.read_text() == '{"mine": true}'


MISTAKES = """
--size 16: "16"
--size 16x0: "16"
--size 15x24: 15 x 24
--precision fp16: fp16
--within 4: --predict
--predict --size 15x24: patches
--sweep views=2..4 --renderer: no renderer
--sweep views=2..4 --memory: measures memory itself
"""


def test_mistakes(monkeypatch):
    nothing = dict.fromkeys(("forward", "render", "step"), 0)
    monkeypatch.setattr(predict, "_calibrate", lambda: (nothing, nothing))
    for words, named in yaml.safe_load(MISTAKES).items():
        error = run_qgs("bench", TOKENGS, *words.split(), "--device", "cpu").exception
        assert isinstance(error, ValueError), words
        assert named in str(error), words


def test_predictions(monkeypatch):
    median = predict._median
    monkeypatch.setattr(predict, "_median", lambda task, *_, **__: median(task, rounds=1))
    shallow = "--set model.decoder.depth=1 --set model.supervision.layers=[1]"
    told = bench(f"{TOKENGS} --predict --within 0.01 {shallow}").output
    assert "does not fit" in " ".join(told.replace("│", " ").split())


def test_what_fits(capsys):
    found = {"peak_bytes": 2e9, "seconds": 0.1}
    entry = {"recipe": "a.yaml", "parameters": 1000, "forward": found, "step": found}
    for within, says in ((2, "│ fits"), (1.9, "│ does not fit")):
        predict.show_predictions([entry], Console(width=120), within)
        assert says in capsys.readouterr().out


def test_a_sweep_takes_turns_and_records_what_fails(tmp_path, monkeypatch):
    calls = []

    def peak_memory(recipe, operation, work, threads):
        if (work.views, recipe.tree["model"]["queries"]["type"]) == (4, "locus/anchored"):
            raise ChildProcessError("killed\nmore")
        return Peak(2**20 * work.views**2 + 1, 1)

    def make_task(operation, recipe, model, work):
        return lambda: calls.append((recipe.tree["model"]["queries"]["type"], work.views))

    monkeypatch.setattr(sweep, "peak_memory", peak_memory)
    monkeypatch.setattr(sweep, "make_task", make_task)
    write, kept = output.write_sweep, Mock(return_value=[])
    monkeypatch.setattr(output, "write_sweep", kept)
    told = bench(f"{TOKENGS} {LOCUS} --sweep views=2..8 --json {tmp_path}/s.json").output
    assert calls[:6] == [("qgs/latent", 2), ("locus/anchored", 2)] * 3
    assert kept.call_count == 3, "the report is written after each point"
    _, table, picture, page = write(*kept.call_args.args)
    report = json.loads((tmp_path / "s.json").read_text())
    (failed,) = report["failed"]
    assert (failed["value"], failed["reason"]) == (4, "ChildProcessError: killed")
    assert "views 4: ChildProcessError: killed" in " ".join(told.split())
    fits = {fit["recipe"]: fit["bytes"]["exponent"] for fit in report["fits"]}
    assert fits == pytest.approx({TOKENGS: 2, LOCUS: 2})
    assert [row["value"] for row in csv.DictReader(table.open())] == ["2", "2", "4", "8", "8"]
    assert picture.stat().st_size > 10_000
    assert page.read_bytes().startswith(b"%PDF")


def test_a_sweep_of_which_nothing_is_measured(monkeypatch):
    failing = Mock(side_effect=ChildProcessError)
    monkeypatch.setattr(sweep, "peak_memory", failing)
    assert isinstance(bench(f"{TOKENGS} --sweep queries=8..16").exception, ValueError)
    recipes = (call.args[0].tree for call in failing.call_args_list)
    assert [recipe["model"]["queries"]["count"] for recipe in recipes] == [8, 16]
