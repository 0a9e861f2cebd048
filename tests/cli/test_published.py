"""The published recipes name data, an index and a base run that the user brings."""

from pathlib import Path

import pytest
from commands import run_qgs, sets

FINETUNE = Path(__file__).parents[2] / "recipes" / "locus" / "dl3dv_4096_2views.yaml"
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
    result = run_qgs("train", FINETUNE, "--out", "run", "--device", "cpu", *sets(*overrides))
    assert isinstance(result.exception, FileNotFoundError)
    with pytest.raises(FileNotFoundError, match=message):
        raise result.exception
    assert list(tmp_path.iterdir()) == []
