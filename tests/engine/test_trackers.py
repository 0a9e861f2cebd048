"""What trackers are told."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_runs import Tiny, tensorboard_events

from qgs.contracts.component import MissingExtraError
from qgs.engine import tracking as trackers
from qgs.engine.distributed import make_accelerator
from qgs.engine.tracking import Trackers


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8)


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r'pip install "query-gaussians\[wandb\]"'):
        Trackers(("wandb",))
    Trackers(()).log({"loss": 1.0}, 1)


def test_tensorboard_gets_numbers_options_and_pictures(tiny: Tiny, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    tracking = Trackers(("tensorboard",))
    tracking.open(tmp_path, tiny("locus"))
    for step in (1, 2):
        tracking.log({"loss": 1 / step, "psnr": 20.0 + step}, step)
    tracking.picture("evaluation", picture(), 2)
    tracking.close()
    events = tensorboard_events(tmp_path)
    found = [(event.step, event.value) for event in events.Scalars("loss")]
    assert found == [(1, 1.0), (2, 0.5)]
    (image,) = events.Images("evaluation")
    assert (image.step, image.height, image.width) == (2, 6, 9)
    options = next((tmp_path / "tensorboard").glob("*/hparams.yml")).read_text()
    assert "model.width: 32" in options


def test_a_resumed_run_takes_back_what_was_told_of_lost_steps(tiny: Tiny, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    for first, value in ((1, 1.0), (3, 2.0)):
        tracking = Trackers(("tensorboard",))
        tracking.open(tmp_path, tiny("locus"), step=first - 1)
        for step in range(first, 5):
            tracking.log({"loss": value}, step)
        tracking.close()
    events = tensorboard_events(tmp_path).Scalars("loss")
    assert [(e.step, e.value) for e in events] == [(1, 1.0), (2, 1.0), (3, 2.0), (4, 2.0)]


class Wandb(types.ModuleType):
    """Stands in for wandb, whose package is large: notes what it is told."""

    def __init__(self) -> None:
        super().__init__("wandb")
        self.told: list[tuple[str, Any]] = []
        self.config = types.SimpleNamespace(update=lambda values, **_: self.note("config", values))
        self.Image = lambda image: image

    def note(self, what: str, value: Any) -> None:
        self.told.append((what, value))

    def init(self, **options: Any) -> types.SimpleNamespace:
        self.note("init", options)
        return types.SimpleNamespace(
            log=lambda values, step: self.note("log", (values, step)),
            finish=lambda: self.note("finish", None),
        )


def test_wandb_continues_one_run(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_accelerator("cpu")
    wandb = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.setattr(trackers, "find_spec", lambda name: object())
    for _ in range(2):
        tracking = Trackers(("wandb",))
        tracking.open(tmp_path / "run", tiny("locus"))
        tracking.log({"loss": 0.5}, 3)
        tracking.picture("evaluation", picture(), 3)
        tracking.close()
    kinds = [what for what, _ in wandb.told]
    assert kinds == ["init", "config", "log", "log", "finish"] * 2
    first, second = (value for what, value in wandb.told if what == "init")
    assert first == second, "the same id"
    assert first["project"] == "qgs"
    assert first["name"] == "run"
    assert Path(first["dir"]) == tmp_path / "run"
    assert wandb.told[2][1] == ({"loss": 0.5}, 3)
    ((images,), step) = wandb.told[3][1][0].values(), wandb.told[3][1][1]
    assert np.array_equal(images[0], picture())
    assert step == 3
