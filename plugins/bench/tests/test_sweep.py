"""`qgs bench --sweep` as a user types it; exponents of known powers."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run_qgs, sets
from qgs_bench import output
from qgs_bench import sweep as sweep_module
from qgs_bench.memory import Peak
from qgs_bench.sweep import fit, parse_axis
from qgs_bench.work import Workload

from qgs.composer import Recipe

RECIPES = Path(__file__).parents[3] / "recipes"
TOKENGS, LOCUS = RECIPES / "tiny/tokengs.yaml", RECIPES / "tiny/locus.yaml"
QUICK = ("--rounds", "2", "--warmup", "1", "--device", "cpu", "--size", "16x24")


def test_axes_double() -> None:
    assert parse_axis("views=2..32").values == (2, 4, 8, 16, 32)
    assert parse_axis("size=24..100").values == (24, 48, 96)


@pytest.mark.parametrize("text", ["views=2-32", "targets=2..32", "views=0..4", "views=4..7"])
def test_no_axis(text: str) -> None:
    with pytest.raises(ValueError, match="AXIS=FIRST"):
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
    fits = [(Path(fit["recipe"]).stem, fit["axis"]) for fit in report["fits"]]
    assert fits == [(name, axis) for axis in ("views", "queries") for name in ("tokengs", "locus")]
    assert all(p["memory"]["peak_bytes"] > p["memory"]["idle_bytes"] for p in report["points"])
    rows = list(csv.DictReader(file.with_suffix(".csv").open()))
    assert [row["value"] for row in rows] == ["2", "2", "4", "4", "8", "8", "16", "16"]
    assert file.with_suffix(".png").stat().st_size > 10_000
    assert file.with_suffix(".pdf").read_bytes().startswith(b"%PDF")


def test_recipes_take_turns_and_what_fails_is_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[tuple[str, int]] = []

    def peak_memory(recipe: Recipe, _: object, work: Workload, __: int) -> Peak:
        if work.views == 4 and recipe.tree["model"]["queries"]["type"] == "locus/anchored":
            raise ChildProcessError("killed\nmore")
        return Peak(2**20 * work.views**2 + 1, 1)

    def make_task(_: object, recipe: Recipe, __: object, work: Workload) -> Callable[[], None]:
        return lambda: calls.append((recipe.tree["model"]["queries"]["type"], work.views))

    monkeypatch.setattr(sweep_module, "peak_memory", peak_memory)
    monkeypatch.setattr(sweep_module, "make_task", make_task)
    file, kept = tmp_path / "s.json", []
    write = output.write_sweep
    monkeypatch.setattr(output, "write_sweep", lambda *given: kept.append(given) or write(*given))
    words = ("--sweep", "views=2..16", "--json", file)
    result = run_qgs("bench", TOKENGS, LOCUS, *words, *QUICK, *sets())
    assert result.exit_code == 0, result.output
    assert calls[:6] == [("qgs/latent", 2), ("locus/anchored", 2)] * 3
    assert len(kept) == 4, "the report is written after each point"
    report = json.loads(file.read_text())
    of_locus = [p["value"] for p in report["points"] if p["recipe"] == str(LOCUS)]
    assert of_locus == [2, 8, 16]
    (failed,) = report["failed"]
    assert (failed["value"], failed["reason"]) == (4, "ChildProcessError: killed")
    assert all(fit["bytes"]["exponent"] == pytest.approx(2) for fit in report["fits"])
    assert "views 4: ChildProcessError: killed" in " ".join(result.output.split())
    monkeypatch.setattr(sweep_module, "peak_memory", lambda *_: 1 / 0)
    nothing = run_qgs("bench", TOKENGS, "--sweep", "views=2..4", *QUICK, *sets())
    assert isinstance(nothing.exception, ValueError)


def test_a_sweep_measures_no_renderer() -> None:
    words = ("--sweep", "views=2..4", "--renderer", "--device", "cpu")
    assert isinstance(run_qgs("bench", TOKENGS, *words).exception, ValueError)
