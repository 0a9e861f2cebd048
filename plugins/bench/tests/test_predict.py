"""Predictions: memory and time beside measured ones, and the command."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from commands import run_qgs, sets
from qgs_bench import predict
from qgs_bench.counting import count
from qgs_bench.memory import peak_memory
from qgs_bench.work import Operation, Workload, make_task, workload_of

from qgs.composer import resolve

RECIPES = Path(__file__).parents[3] / "recipes"
TOKENGS = RECIPES / "tiny/tokengs.yaml"
PREDICT = """
import json, sys, time, torch
from qgs_bench import predict
predict.timer = time.process_time
torch.set_num_threads(1)
print(json.dumps(predict.predict_recipes([sys.argv[1]], {})))
"""


def test_counts_follow_shapes() -> None:
    recipe = resolve(TOKENGS, ["model.width=16", "model.heads=2"])
    once, twice = (count(recipe, "step", Workload(2, 2, (16, 24), batch=n)) for n in (1, 2))
    weights = sum(p.nbytes for p in recipe.build_model("meta").parameters())
    assert once.parameters * 4 == weights
    assert twice.splats == 2 * once.splats == 2 * 2 * 2 * 256 * 8  # scenes, views, layers
    assert once.peak > 4 * weights, "weights, gradients and two moments"
    assert twice.peak > once.peak


@pytest.mark.parametrize(
    ("within", "says"),
    [pytest.param("100", "fits", marks=pytest.mark.slow), ("0.01", "does not fit")],
)
def test_the_command(within: str, says: str) -> None:
    words = ("--predict", "--within", within, "--size", "16x24", "--device", "cpu")
    result = run_qgs("bench", TOKENGS, *words, *sets())
    assert result.exit_code == 0, result.output
    assert says in " ".join(result.output.replace("│", " ").split())


def test_mistakes() -> None:
    assert isinstance(run_qgs("bench", TOKENGS, "--within", "4").exception, ValueError)
    uneven = run_qgs("bench", TOKENGS, "--predict", "--size", "15x24", *sets())
    assert "patches" in str(uneven.exception)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tokengs", "locus", "mvsplat", "depthsplat"])
def test_near_the_measured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of processor time, which other processes disturb less."""
    monkeypatch.setattr(predict, "timer", time.process_time)
    torch.set_num_threads(1)
    path = RECIPES / f"tiny/{name}.yaml"
    recipe = resolve(path)
    work = workload_of(recipe)
    # in a fresh process, which holds nothing of earlier tests
    done = subprocess.run([sys.executable, "-c", PREDICT, str(path)], stdout=subprocess.PIPE)
    (found,) = json.loads(done.stdout)
    operations: tuple[Operation, ...] = ("forward", "step")
    for operation in operations:
        task = make_task(operation, recipe, recipe.build_model(), work)
        assert found[operation]["seconds"] == pytest.approx(predict._median(task, 7), rel=0.3)
        peak = peak_memory(recipe, operation, work, threads=1).peak_bytes
        assert found[operation]["peak_bytes"] == pytest.approx(peak, rel=0.15)
