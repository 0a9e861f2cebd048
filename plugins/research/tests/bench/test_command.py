"""`qgs bench` as a user types it."""

import re

from commands import run_qgs
from qgs_research.bench import run
from tables import read_json

TOKENGS = "tiny/tokengs.yaml"
LOCUS = "tiny/locus.yaml"
GSLRM = "tiny/gslrm.yaml"
SETTINGS = ["model.width=16", "model.heads=2", "model.head.gaussians_per_query=2"]
SMALL = f"--size 16x24 --device cpu --rounds 3 --warmup 0 --set {' --set '.join(SETTINGS)}"


def bench(words):
    return run_qgs(f"bench {words} {SMALL}")


def test_recipes_are_compared_with_the_first(tmp_path, monkeypatch):
    peaks = iter([30, 60, 15, 15, 60, 90])
    monkeypatch.setattr(run, "peak_memory", lambda *_: run.Peak(2**20 * next(peaks), 2**20))
    everything = f"--step --memory --renderer --views 3 --json {tmp_path}/reports/bench.json"
    told = bench(f"{TOKENGS} {LOCUS} {GSLRM} {everything}").output
    report = read_json(tmp_path / "reports/bench.json")
    assert report["machine"].keys() >= {"device", "processor", "threads", "torch"}
    assert report["overrides"] == SETTINGS
    assert report["rounds"] == 3
    assert report["warmup"] == 0
    recipes = report["recipes"]
    first = recipes[0]
    gaussians = {TOKENGS: 512, LOCUS: 512, GSLRM: None}
    assert {recipe["recipe"]: recipe["gaussians"] for recipe in recipes} == gaussians
    for recipe in recipes:
        count = recipe["parameters"]["count"]
        assert recipe["views"] == 3
        assert recipe["size"] == [16, 24]
        assert recipe["precision"] == "float32"
        assert recipe["parameters"]["weight_bytes"] == 4 * count
        assert recipe["parameters"]["ratio"] == count / first["parameters"]["count"]
        assert f"{count:,}" in told
        assert f"{recipe['flops'] / 1e9:.3f}" in told
        assert list(recipe["seconds"]) == ["forward", "render", "step"]
        for kind, times in recipe["seconds"].items():
            pairs = zip(times["samples"], first["seconds"][kind]["samples"], strict=True)
            assert times["ratio"]["median"] == sorted(own / base for own, base in pairs)[1]
    ratios = [[kind["ratio"] for kind in recipe["memory"].values()] for recipe in recipes]
    assert ratios == [[1, 1], [0.5, 0.25], [2, 1.5]]
    assert re.search(r"(?s)tokengs +│ 3 x 16 x 24 +│ +512.*gslrm +│ 3 x 16 x 24 +│ +per view", told)


def test_a_report_replaces_nothing(tmp_path):
    file = tmp_path / "bench.json"
    file.write_text('{"mine": true}')
    assert isinstance(bench(f"{TOKENGS} --json {file}").exception, FileExistsError)
    assert file.read_text() == '{"mine": true}'
