"""What the demo shows, on a shorter budget: minutes of training."""

from pathlib import Path

import pytest
from rich.console import Console

from qgs.composer import resolve
from qgs.engine.evaluation import evaluate
from qgs.engine.training import train

RECIPES = Path(__file__).parents[2] / "recipes" / "tiny"
SECONDS = 60


@pytest.mark.slow
def test_locusgs_is_ahead_of_tokengs_and_of_the_baselines(tmp_path: Path) -> None:
    evaluations = {}
    for name in ("tokengs", "locus"):
        recipe = resolve(RECIPES / f"{name}.yaml", [f"training.seconds={SECONDS}"])
        result = train(recipe, tmp_path / name, console=Console(quiet=True))
        evaluations[name] = evaluate(result.model, recipe)
    token, locus = evaluations["tokengs"], evaluations["locus"]
    assert locus.mean("psnr") > token.mean("psnr")
    assert token.mean("psnr") > token.mean("psnr", "mean_colour")
    dispersion = [e.mean("dispersion_median") for e in (token, locus)]
    assert dispersion[1] < dispersion[0]
