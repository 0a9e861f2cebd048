"""States and checkpoints that are damaged, samples that cannot be made, memory that runs out."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from training_runs import Tiny, run

from qgs.data.stream import MAX_REPLACED, SampleError, SampleStream
from qgs.engine import training
from qgs.engine.folder import read_state
from qgs.engine.guard import OutOfMemoryError
from qgs.io.tensors import CheckpointError, write_tensors

WEIGHT = "queries.features"
EMA = "training.ema=0.9"


def rewrite(path: Path, change: Callable[[dict[str, torch.Tensor]], Any], **metadata: str) -> None:
    """Write a safetensors file again with changed tensors, and metadata but for `metadata`."""
    with safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        known = file.metadata()
    change(tensors)
    write_tensors(path, tensors, known | metadata)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, tiny: Tiny) -> Path:
    folder = tmp_path_factory.mktemp("damaged") / "run"
    run(tiny("tokengs", "training.steps=3", EMA), folder)
    return folder


@pytest.fixture
def copied(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.update({f"weights/{WEIGHT}": t[f"weights/{WEIGHT}"][:1].clone()}),
        lambda t: t.pop(f"ema/{WEIGHT}"),
        lambda t: t.update({"moments/foo/exp_avg": torch.ones(1)}),
        lambda t: t.pop(f"moments/model.{WEIGHT}/exp_avg"),
        lambda t: [t.pop(name) for name in list(t) if name.startswith("random/")],
    ],
    ids=["another shape", "missing", "unknown parameter", "moment", "a part without tensors"],
)
def test_a_state_with_other_tensors_is_refused_and_nothing_is_replaced(
    copied: Path, tiny: Tiny, change: Any
) -> None:
    state = copied / "state.safetensors"
    rewrite(state, change)
    before = {path.name: path.read_bytes() for path in copied.iterdir() if path.is_file()}
    with pytest.raises(CheckpointError) as caught:
        run(tiny("tokengs", "training.steps=4", EMA), copied, resume=True)
    assert str(state) in str(caught.value)
    assert before == {p.name: p.read_bytes() for p in copied.iterdir() if p.is_file()}


@pytest.mark.parametrize("text", ["null", '{"counters": ', '{"a":' * 5000, '{"weights": {}}'])
def test_a_state_with_damaged_values_is_refused(copied: Path, tiny: Tiny, text: str) -> None:
    rewrite(copied / "state.safetensors", lambda tensors: None, **{"qgs.state": text})
    with pytest.raises(CheckpointError, match=str(copied)):
        run(tiny("tokengs", "training.steps=4", EMA), copied, resume=True)


def test_a_step_without_memory_says_what_takes_less_and_the_run_is_saved(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute = training.compute_gradients
    steps: list[int] = []

    def fail(*arguments: Any) -> Any:
        steps.append(1)
        if len(steps) == 3:
            raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")
        return compute(*arguments)

    recipe = tiny("tokengs", "training.save_every=0")
    with monkeypatch.context() as patch:
        patch.setattr(training, "compute_gradients", fail)
        with pytest.raises(OutOfMemoryError, match=r"step 3.*batch_size"):
            run(recipe, tmp_path / "run")
    assert run(recipe, tmp_path / "run", resume=True).resumed_at == 2


def bad_frames(monkeypatch: pytest.MonkeyPatch, bad: Callable[[int], bool]) -> None:
    made = SampleStream._made

    def failing(stream: SampleStream, number: int, attempt: int) -> Any:
        if bad(number + attempt):
            raise SampleError(f"scene 'x', frame {number + attempt} (a.png): cannot be read")
        return made(stream, number, attempt)

    monkeypatch.setattr(SampleStream, "_made", failing)


def test_bad_samples_are_skipped_counted_and_named_if_asked_for(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bad_frames(monkeypatch, lambda number: number in (3, 5))
    with pytest.raises(SampleError, match="frame 3"):
        run(tiny("tokengs"), tmp_path / "stops")
    result = run(tiny("tokengs", "training.on_bad_sample=skip"), tmp_path / "skips")
    assert result.steps == 4
    assert [reason.split("(")[0] for reason in result.left_out] == [
        "scene 'x', frame 3 ",
        "scene 'x', frame 5 ",
    ]
    assert caplog.text.count("a sample is left out") == 2
    state = read_state(tmp_path / "skips" / "state.safetensors").parts["counters"]
    assert state["left_out"] == result.left_out


def test_too_many_bad_samples_in_a_row_end_a_run_all_the_same(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad_frames(monkeypatch, lambda number: number > 1)
    with pytest.raises(SampleError, match=str(MAX_REPLACED + 1)):
        run(tiny("tokengs", "training.on_bad_sample=skip"), tmp_path / "run")
