"""The published recipes name data, an index and a base run that the user brings."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from qgs.cli import app

FINETUNE = Path(__file__).parents[2] / "recipes" / "locus" / "dl3dv_4096_2views.yaml"
SMALL = (
    "model.width=16",
    "model.heads=2",
    "model.queries.count=8",
    "training.steps=2",
    "optimizer.warmup=1",
)
ROOMS = "data={type: rooms/procedural, image_size: [16, 16]}"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((), "no evaluation index at .*datasets/dl3dv/evaluation_2views.json"),
        (("evaluation.index=null", "init_from=null"), "datasets/dl3dv"),
        (("evaluation.index=null", "plugins=[rooms]", ROOMS), "runs/locus/dl3dv"),
    ],
    ids=["index", "data", "base run"],
)
def test_what_is_missing_is_told_before_training(
    overrides: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sets = [word for setting in (*SMALL, *overrides) for word in ("--set", setting)]
    words = ["train", str(FINETUNE), "--out", "run", "--device", "cpu", *sets]
    result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, FileNotFoundError)
    with pytest.raises(FileNotFoundError, match=message):
        raise result.exception
    assert list(tmp_path.iterdir()) == []
