"""`qgs bench --sweep` and `--predict` as a user types them; exponents of known powers."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from commands import run_qgs, sets
from qgs_bench import output
from qgs_bench import sweep as sweep_module
from qgs_bench.counting import Counted
from qgs_bench.memory import Peak
from qgs_bench.sweep import fit, parse_axis
from qgs_bench.work import Workload

from qgs.composer import Recipe, resolve

RECIPES = Path(__file__).parents[3] / "recipes"
TOKENGS, LOCUS = RECIPES / "tiny/tokengs.yaml", RECIPES / "tiny/locus.yaml"
QUICK = ("--rounds", "2", "--warmup", "1", "--device", "cpu", "--size", "16x24")


def test_axes_double() -> None:
    assert parse_axis("views=2..32").values == (2, 4, 8, 16, 32)
    assert parse_axis("queries=256..16384").values == tuple(256 * 2**n for n in range(7))
    assert parse_axis("size=24..100").values == (24, 48, 96)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("views=2-32", "AXIS=FIRST..LAST, such as views=2..32"),
        ("targets=2..32", "an axis of views, queries, size, batch"),
        ("views=0..4", "AXIS=FIRST..LAST"),
        ("views=4..7", "one point.*at least 8"),
    ],
)
def test_no_axis_is_told(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_axis(text)


def test_the_exponent_of_a_power_and_its_error() -> None:
    found = fit([2, 4, 8, 16], [3 * n**1.5 for n in (2, 4, 8, 16)])
    assert found is not None
    assert found.error is not None
    assert (found.exponent, found.factor, found.last) == pytest.approx((1.5, 3, 1.5))
    assert found.error < 1e-9
    noisy = fit([1, 2, 4], [1, 2, 8])  # logarithms 0, 1, 3: slope 1.5, residuals 1/6, -1/3, 1/6
    assert noisy is not None
    assert (noisy.exponent, noisy.last) == pytest.approx((1.5, 2))
    assert noisy.error == pytest.approx((6 / 36 / 2) ** 0.5)
    assert getattr(fit([2, 4], [1, 2]), "error", 0) is None
    assert fit([2], [1]) is None


@pytest.mark.slow
def test_a_sweep_writes_table_and_figure(tmp_path: Path) -> None:
    file = tmp_path / "sweep.json"
    words = ("bench", TOKENGS, LOCUS, "--sweep", "views=2..4", "--sweep", "queries=8..16")
    result = run_qgs(*words, *QUICK, "--json", file, *sets())
    assert result.exit_code == 0, result.output
    report = json.loads(file.read_text())
    series = report["series"]
    kinds = [(Path(s["recipe"]).stem, s["axis"], s["operation"]) for s in series]
    assert kinds == [(n, a, "forward") for n in ("tokengs", "locus") for a in ("views", "queries")]
    assert [p["value"] for p in series[1]["points"]] == [8, 16]
    for one in series:
        low, high = one["points"]
        assert 0 < low["counted_bytes"] <= high["counted_bytes"]
        assert low["memory"]["peak_bytes"] > low["memory"]["idle_bytes"] > 0
        assert one["fits"]["seconds"]["error"] is None
    rows = list(csv.DictReader(file.with_suffix(".csv").open()))
    assert [row["value"] for row in rows] == ["2", "4", "8", "16"] * 2
    assert file.with_suffix(".png").stat().st_size > 10_000
    assert file.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    assert "exponents: time" in result.output
    file.unlink()
    refused = run_qgs(*words, *QUICK, "--json", file, *sets())
    assert isinstance(refused.exception, FileExistsError)
    assert "sweep.csv, sweep.png, sweep.pdf" in str(refused.exception)


@pytest.mark.slow
def test_what_does_not_fit_is_left_out_and_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    small = 495 * 2**20
    monkeypatch.setattr(sweep_module, "available", lambda device: small)
    words = ("--sweep", "queries=8..32768", "--step", "--json", tmp_path / "s.json")
    changed = [("--set", "model.width=16"), ("--set", "model.heads=2")]
    monkeypatch.setattr(sweep_module, "peak_memory", lambda *_: Peak(3, 1))
    monkeypatch.setattr(sweep_module, "make_task", lambda *_: lambda: None)
    result = run_qgs("bench", TOKENGS, *words, *QUICK, *(w for pair in changed for w in pair))
    assert result.exit_code == 0, result.output
    _, step = json.loads((tmp_path / "s.json").read_text())["series"]
    left = [m["value"] for m in step["left_out"]]
    assert left
    assert [p["value"] for p in step["points"]] + left == [8 * 2**n for n in range(13)]
    assert f"left out: queries {left[0]} needs" in result.output
    assert "519 MB are available" in result.output


@pytest.mark.slow
def test_a_prediction_says_what_fits(tmp_path: Path) -> None:
    recipe, file = resolve(LOCUS), tmp_path / "p.json"
    words = ("--predict", "--within", "1GB", "--device", "cpu", "--json", file)
    result = run_qgs("bench", LOCUS, *words)
    assert result.exit_code == 0, result.output
    assert f"B x V x H x W {recipe.training.batch_size} x 2 x 64 x 64" in " ".join(
        result.output.split()
    )
    assert "fits into 1 GB on cpu; the largest batch that does is " in result.output
    assert "kept for the backward pass: encoder " in result.output
    report = json.loads(file.read_text())
    assert (report["report"], report["limit_bytes"]) == ("qgs bench --predict", 10**9)
    (found,) = report["recipes"]
    total = sum(found["step"].values()) + sum(found["besides"].values())
    assert (found["recipe"], found["fits"], found["total_bytes"]) == (str(LOCUS), True, total)
    assert found["largest_batch"] > found["batch"] == recipe.training.batch_size
    assert 0 < found["tensor_bytes"] < total
    assert sum(found["kept"].values()) < found["tensor_bytes"]
    other = run_qgs("bench", LOCUS, "--sweep", "views=2..4", "--json", file)
    assert isinstance(other.exception, FileExistsError)
    tight = run_qgs("bench", LOCUS, "--predict", "--within", "10MB", "--device", "cuda")
    assert "does not fit into 10 MB on cuda; not even a batch of 1 does" in tight.output


def test_recipes_take_turns_and_what_fails_is_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[tuple[str, int]] = []

    def make_task(_: object, recipe: Recipe, __: object, work: Workload) -> Callable[[], None]:
        kind = recipe.tree["model"]["queries"]["type"]
        if work.views == 4 and kind == "locus/anchored":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB.\nMore.")

        def task() -> None:
            calls.append((kind, work.views))
            if work.views == 16 and kind == "qgs/latent" and calls.count(calls[-1]) == 2:
                raise RuntimeError("gone in the second call")

        return task

    monkeypatch.setattr(sweep_module, "peak_memory", lambda *_: Peak(3, 1))
    monkeypatch.setattr(sweep_module, "make_task", make_task)
    file, kept = tmp_path / "s.json", []
    write = output.write_sweep
    monkeypatch.setattr(output, "write_sweep", lambda *given: kept.append(given) or write(*given))
    words = ("--sweep", "views=2..16", "--json", file)
    result = run_qgs("bench", TOKENGS, LOCUS, *words, *QUICK, *sets())
    assert result.exit_code == 0, result.output
    assert calls[:6] == [("qgs/latent", 2), ("locus/anchored", 2)] * 3
    assert len(kept) == 4, "the report is kept after each point"
    tokengs, locus = json.loads(file.read_text())["series"]
    assert [p["value"] for p in tokengs["points"]] == [2, 4, 8]
    assert [p["value"] for p in locus["points"]] == [2, 8, 16]
    (gone,), (memory,) = tokengs["failed"], locus["failed"]
    assert (gone["value"], gone["reason"]) == (16, "RuntimeError: gone in the second call")
    told = "OutOfMemoryError: CUDA out of memory. Tried to allocate 9 GiB."
    assert (memory["value"], memory["reason"]) == (4, told)
    assert locus["fits"]["seconds"] is not None
    assert f"failed: views 4 {told}" in " ".join(result.output.split())


def test_a_sweep_of_which_nothing_can_be_measured_is_an_error() -> None:
    words = ("--sweep", "batch=1..2", *QUICK[:-1], "15x24")
    result = run_qgs("bench", TOKENGS, *words, *sets())
    assert isinstance(result.exception, ValueError)
    assert "no point of the sweep could be measured" in str(result.exception)
    assert "failed: batch 1 ValueError: " in result.output
    assert "cannot be cut into patches" in " ".join(result.output.split())


def test_two_recipes_fit_together_or_the_second_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sweep_module, "PROCESS", {"cpu": 0})
    monkeypatch.setattr(sweep_module, "RESERVE", 0)
    work = Workload(2, 2, (16, 24))
    recipe = resolve(TOKENGS)
    counted = Counted(weights=10, inputs=5, gradients=10, moments=20, kept={}, peak=100)

    def left_out(limit: int) -> list[str]:
        monkeypatch.setattr(sweep_module, "available", lambda device: limit)
        runs = [sweep_module._Run(recipe, work, "step", counted) for _ in range(2)]
        sweep_module._leave_out(runs)
        return [run.missing[1] if run.missing else "" for run in runs]

    assert left_out(145) == ["", ""], "what both keep, and the activations of one"
    assert left_out(144) == [
        "",
        "needs 145 bytes with the recipes before it, 144 bytes are available",
    ]
    assert left_out(99)[0] == "needs 100 bytes, 99 bytes are available"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--sweep", "views=2..4", "--predict"], "--predict stands alone; give --sweep in a call"),
        (["--sweep", "views=2..4", "--memory"], "--sweep stands alone; give --memory in a call"),
        (["--within", "2GB"], "give --predict too"),
        (["--predict", "--within", "2 gigs"], "must be a size such as 24GB"),
    ],
)
def test_options_that_do_not_go_together(words: list[str], message: str) -> None:
    result = run_qgs("bench", TOKENGS, *words, "--device", "cpu")
    assert isinstance(result.exception, ValueError)
    assert message in str(result.exception)
