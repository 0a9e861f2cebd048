"""States and checkpoints of other tensors than were written, runs that do not fit, lost folders."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from training_runs import Tiny, change_batches, run, run_calling

import qgs
from qgs.data.sampling import Batch
from qgs.data.stream import MAX_REPLACED, SampleError, SampleStream
from qgs.engine import training
from qgs.engine.checkpoint import read_state
from qgs.engine.fit import OutOfMemoryError, explained, refuse_unfit
from qgs.engine.folder import FolderGoneError, RunFolder
from qgs.io.checkpoint import CheckpointFile
from qgs.io.tensors import CheckpointError
from qgs.memory import TooLargeError, in_words, refuse_beyond_memory

TOOLS = Path(__file__).parents[2] / "tools"


def rewrite(path: Path, change: Callable[[dict[str, torch.Tensor]], Any], **metadata: str) -> None:
    """Write a safetensors file again, whole, with changed tensors and the same metadata."""
    with safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        known = file.metadata()
    change(tensors)
    known.pop("qgs.digest", None)
    save_file(tensors, path, known | metadata)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, tiny: Tiny) -> Path:
    folder = tmp_path_factory.mktemp("damaged") / "run"
    run(tiny("tokengs", "training.steps=3", "training.ema=0.9"), folder)
    return folder


@pytest.fixture
def copied(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


def first_row(name: str) -> Callable[[dict[str, torch.Tensor]], None]:
    return lambda tensors: tensors.update({name: tensors[name][:1].clone()})


def as_integers(name: str) -> Callable[[dict[str, torch.Tensor]], None]:
    return lambda tensors: tensors.update({name: tensors[name].view(torch.int32)})


def with_nan(name: str) -> Callable[[dict[str, torch.Tensor]], Any]:
    return lambda tensors: tensors[name].view(-1)[:1].fill_(torch.nan)


WEIGHT = "queries.features"
EMA = "training.ema=0.9"
MOMENT = "moments/model.queries.features/exp_avg"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (first_row(f"weights/{WEIGHT}"), WEIGHT),
        (first_row(f"good/0/{WEIGHT}"), WEIGHT),
        (first_row(f"ema/{WEIGHT}"), WEIGHT),
        (as_integers(f"weights/{WEIGHT}"), "int32"),
        (lambda t: t.pop(f"weights/{WEIGHT}"), WEIGHT),
        (lambda t: t.update({"weights/foo": torch.ones(1)}), "foo"),
        (lambda t: t.update({"moments/foo/exp_avg": torch.ones(1)}), "foo"),
        (with_nan(f"weights/{WEIGHT}"), "not finite"),
        (with_nan(MOMENT), "not finite"),
        (first_row(MOMENT), MOMENT.partition("/")[2]),
        (lambda t: t.update({MOMENT: t[MOMENT].double()}), MOMENT.partition("/")[2]),
        (lambda t: [t.pop(name) for name in list(t) if name.endswith("/exp_avg")], "exp_avg"),
        (lambda t: [t.pop(n) for n in list(t) if n.startswith(MOMENT[:-7])], "queries.features"),
        (lambda t: t.update({f"{MOMENT[:-7]}foo": torch.ones(1)}), "queries.features.foo"),
        (lambda t: t[f"{MOMENT}_sq"].neg_(), "negative or NaN: .*exp_avg_sq"),
        (lambda t: t[f"{MOMENT[:-7]}step"].fill_(-5), "negative or NaN: .*step"),
        (lambda t: t[MOMENT].fill_(torch.inf), "not finite: .*exp_avg"),
    ],
)
def test_a_state_with_other_tensors_is_refused_and_nothing_is_replaced(
    copied: Path, tiny: Tiny, change: Any, words: str
) -> None:
    state = copied / "state.safetensors"
    rewrite(state, change)
    before = {path.name: path.read_bytes() for path in copied.iterdir() if path.is_file()}
    with pytest.raises(CheckpointError, match=words) as caught:
        run(tiny("tokengs", "training.steps=4", "training.ema=0.9"), copied, resume=True)
    assert str(state) in str(caught.value)
    assert before == {p.name: p.read_bytes() for p in copied.iterdir() if p.is_file()}


@pytest.mark.parametrize(
    "domain",
    ['{"samples": 1e999, "ranges": {}}',
     '{"samples": 3, "ranges": {"fov": [1' + "0" * 400 + ", 2]}}",
     '{"samples": 3, "ranges": {"fov": 7}}', "[]", '{"samples": 3}', "{", "[" * 9000],
    ids=lambda text: text[:40],
)  # fmt: skip
def test_a_damaged_domain_is_told_with_its_file(copied: Path, domain: str) -> None:
    file = copied / "checkpoint.safetensors"
    rewrite(file, lambda tensors: None, **{"qgs.extra.trained_on": domain})
    with pytest.raises(CheckpointError, match=r"trained_on` in its metadata") as caught:
        _ = CheckpointFile(file).domain
    assert str(file) in str(caught.value)


def test_a_run_starts_from_no_weights_that_are_not_finite(
    copied: Path, tiny: Tiny, tmp_path: Path
) -> None:
    file = copied / "checkpoint.safetensors"
    rewrite(file, with_nan(WEIGHT))
    with pytest.raises(ValueError, match=f"{file}: weights are not finite: {WEIGHT}"):
        run(tiny("tokengs", f"init_from={file}"), tmp_path / "other")
    rewrite(file, as_integers(WEIGHT))
    with pytest.raises(
        CheckpointError, match=f"{file} does not fit (.|\\n)*type of {WEIGHT}: torch.int32"
    ):
        run(tiny("tokengs", f"init_from={file}"), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_moments_are_finite_but_squares(copied: Path, tiny: Tiny) -> None:
    state = copied / "state.safetensors"
    for name, sound in ((f"{MOMENT}_sq", True), (MOMENT, False)):
        change = lambda t, name=name: t[name].view(-1)[:1].fill_(torch.inf)  # noqa: E731
        rewrite(state, change)
        if sound:
            run(tiny("tokengs", "training.steps=4", EMA), copied, resume=True)
            continue
        with pytest.raises(CheckpointError, match=r"`moments` cannot be restored .not finite") as e:
            run(tiny("tokengs", "training.steps=5", EMA), copied, resume=True)
        assert str(state) in str(e.value)


def test_a_run_that_cannot_go_on_is_told_with_its_file(copied: Path, tiny: Tiny) -> None:
    state = copied / "state.safetensors"
    for options in (["seed=5"], ["training.batch_size=7"]):
        with pytest.raises(ValueError, match=f"^{state} is of a run "):
            run(tiny("tokengs", EMA, *options), copied, resume=True)
    state.unlink()
    state.mkdir()
    with pytest.raises(FileExistsError, match=f"^{state} is missing or no file"):
        run(tiny("tokengs", EMA), copied, resume=True)


def test_messages_of_damage_stay_short(copied: Path) -> None:
    file = copied / "checkpoint.safetensors"
    whole = file.read_bytes()
    header = whole[8 : 8 + int.from_bytes(whole[:8], "little")].replace(
        b'"F32"', b'"%s"' % (b"x" * 10**5)
    )
    file.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(CheckpointError, match="is not a whole safetensors file") as caught:
        qgs.load(file)
    assert len(str(caught.value)) < 1000


def test_a_checkpoint_of_other_types_is_refused_and_half_precision_is_widened(copied: Path) -> None:
    file = copied / "checkpoint.safetensors"

    def halve(tensors: dict[str, torch.Tensor]) -> None:
        tensors[WEIGHT] = tensors[WEIGHT].half()

    rewrite(file, halve)
    assert qgs.load(file).queries.state_dict()["features"].dtype == torch.float32
    rewrite(file, lambda t: t.update({n: x.float().view(torch.int32) for n, x in t.items()}))
    with pytest.raises(CheckpointError, match=r"type of .*: torch\.int32 in the file"):
        qgs.load(file)


@pytest.mark.parametrize("option", ["width", "queries.count", "head.gaussians_per_query"])
def test_sizes_of_a_checkpoint_are_compared_before_anything_is_allocated(
    copied: Path, option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = copied / "checkpoint.safetensors"
    with safe_open(file, "pt") as opened:
        tree = json.loads(opened.metadata()["qgs.recipe"])
    *above, last = option.split(".")
    below = tree["model"]
    for key in above:
        below = below[key]
    below[last] = 65_536 if option == "width" else 10**9
    rewrite(file, lambda tensors: None, **{"qgs.recipe": json.dumps(tree)})
    monkeypatch.setattr(torch.nn.init, "normal_", None)
    monkeypatch.setattr(torch, "randn", lambda *shape: torch.empty(shape, device="meta"))
    with pytest.raises(CheckpointError, match="does not fit the model of its recipe"):
        qgs.load(file)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("views.targets=1000000000", r"\(2 \+ 1000000000\) images of 16 x 16"),
        ("training.batch_size=1000000000", "batch_size 1000000000"),
        ("training.accumulate=1000000000", "1000000001 times"),
        ("data.image_size=[800000, 800000]", "800000 x 800000"),
        ("model.queries.count=10000000000", "the weights, "),
    ],
)
def test_a_training_that_cannot_fit_says_so_with_numbers(
    tiny: Tiny, tmp_path: Path, setting: str, words: str
) -> None:
    with pytest.raises(TooLargeError, match=words) as caught:
        run(tiny("tokengs", setting), tmp_path / "run")
    assert "available" in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_a_model_that_cannot_fit_is_refused_with_its_largest_part(tiny: Tiny) -> None:
    with pytest.raises(TooLargeError, match=r"queries\.features .* TB"):
        tiny("tokengs", "model.queries.count=100000000000").build_model()


def test_what_fits_is_not_refused() -> None:
    refuse_beyond_memory("this", {"a": 4, "b": 6}, "Less.", 10)
    with pytest.raises(TooLargeError, match=r"11 bytes .* 10 bytes are available: b 7 bytes, a 4"):
        refuse_beyond_memory("this", {"a": 4, "b": 7}, "Less.", 10)
    assert [in_words(n) for n in (999, 1500, 2 * 10**30)] == ["999 bytes", "1.5 kB", "2e+15 PB"]


def test_out_of_memory_is_told_and_the_run_is_saved(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute = training.compute_gradients
    steps: list[int] = []

    def fail(*arguments: Any) -> Any:
        steps.append(1)
        if len(steps) == 3:
            raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")
        return compute(*arguments)

    monkeypatch.setattr(training, "compute_gradients", fail)
    recipe = tiny("tokengs", "training.save_every=0")
    with pytest.raises(OutOfMemoryError, match=r"in step 3 .*saved at step 2.*lower training") as e:
        run(recipe, tmp_path / "run")
    assert "batch_size" in str(e.value)
    monkeypatch.undo()
    assert run(recipe, tmp_path / "run", resume=True).resumed_at == 2


def test_data_that_finds_no_memory_tells_that_the_run_is_saved(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(batch: Batch, numbers: Sequence[int]) -> None:
        if max(numbers) >= 2:
            raise MemoryError

    change_batches(monkeypatch, fail)
    recipe = tiny("tokengs", "training.save_every=0", "training.batch_size=1")
    with pytest.raises(OutOfMemoryError, match=r"The run is saved at step 2\. With --resume, "):
        run(recipe, tmp_path / "run")
    assert read_state(tmp_path / "run/state.safetensors").parts["counters"]["step"] == 2


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("CUDA out of memory.\nTried")])
def test_running_out_of_memory_is_told_in_one_line(error: Exception) -> None:
    words = rf"available\): {type(error).__name__}.*batch_size"
    with pytest.raises(OutOfMemoryError, match=words), explained(3):
        raise error


def test_what_torch_holds_in_reserve_is_free(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, gpu = tiny("tokengs"), SimpleNamespace(num_processes=1, device=torch.device("cuda"))
    monkeypatch.setattr("qgs.engine.fit.wants_shards", lambda accelerator: False)
    for name, bytes_ in {"memory_reserved": 10**12, "memory_allocated": 10**3}.items():
        monkeypatch.setattr(torch.cuda, name, lambda device, bytes_=bytes_: bytes_)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (0, 10**12))
    refuse_unfit(recipe, gpu)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 10**12)
    with pytest.raises(TooLargeError, match=r"on the GPU, .* 0 bytes are available"):
        refuse_unfit(recipe, gpu)


@pytest.mark.parametrize("how", ["deleted", "replaced"])
def test_a_folder_lost_while_training_is_told_and_what_was_learnt_is_kept(
    tiny: Tiny, tmp_path: Path, how: str
) -> None:
    recipe, folder = tiny("tokengs", "training.save_every=1"), tmp_path / "run"

    def lose(trainer: Any, stop: Any) -> None:
        if trainer.step == 2:
            shutil.move(folder, tmp_path / "elsewhere")
            if how == "replaced":
                folder.mkdir()

    with pytest.raises(FolderGoneError, match="was deleted, moved or replaced"):
        run_calling(lose, recipe, folder)
    assert not folder.exists() or not list(folder.iterdir())
    assert len(RunFolder(tmp_path / "elsewhere").history()) == 2


def test_a_run_whose_folder_was_deleted_goes_on_beside_it(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tensorboard")
    recipe, folder = tiny("tokengs", "training.trackers=[tensorboard]"), tmp_path / "run"
    gone = RunFolder.append

    def lose(self: RunFolder, record: Any) -> None:
        if record["step"] == 3:
            shutil.rmtree(folder)
        gone(self, record)

    monkeypatch.setattr(RunFolder, "append", lose)
    with pytest.raises(FolderGoneError) as caught:
        run(recipe, folder)
    monkeypatch.undo()
    place = tmp_path / "run-saved-1"
    assert str(place) in caught.value.__notes__[0]
    assert not folder.exists()
    saved = {path.name for path in place.iterdir()}
    assert saved == {"recipe.yaml", "checkpoint.safetensors", "state.safetensors"}
    assert run(recipe, place, resume=True).resumed_at == 3


def test_a_step_that_is_not_finite_does_not_make_a_lost_folder_again(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(batch: Batch, numbers: Sequence[int]) -> None:
        if numbers[0] == 4:
            batch.targets.images[0, 0, 0, 0, 0] = torch.nan

    def lose(trainer: Any, stop: Any) -> None:
        if trainer.step == 2:
            shutil.rmtree(tmp_path / "run")

    change_batches(monkeypatch, spoil)
    with pytest.raises(FolderGoneError):
        run_calling(lose, tiny("tokengs"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


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
    skips = tiny("tokengs", "training.on_bad_sample=skip")
    result = run(skips, tmp_path / "skips")
    assert result.steps == 4
    assert [reason.split("(")[0] for reason in result.left_out] == [
        "scene 'x', frame 3 ",
        "scene 'x', frame 5 ",
    ]
    assert caplog.text.count("a sample is left out") == 2
    state = read_state(tmp_path / "skips" / "state.safetensors").parts["counters"]
    assert state["left_out"] == result.left_out


def test_the_reasons_of_left_out_samples_do_not_grow_without_end(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "MAX_REASONS", 2)
    bad_frames(monkeypatch, lambda number: number % 2 == 1)
    result = run(tiny("tokengs", "training.on_bad_sample=skip"), tmp_path / "run")
    *told, others = result.left_out.items()
    assert len(told) == 2
    assert others == (training.OTHERS, 2)


def test_too_many_bad_samples_in_a_row_end_a_run_all_the_same(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad_frames(monkeypatch, lambda number: number > 1)
    with pytest.raises(SampleError, match=f"{MAX_REPLACED + 1} samples in a row"):
        run(tiny("tokengs", "training.on_bad_sample=skip"), tmp_path / "run")


def test_skipping_changes_no_sound_sample(
    tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, list[Sequence[str]]] = {"stop": [], "skip": []}
    for way in seen:

        def note(batch: Batch, numbers: Sequence[int], way: str = way) -> None:
            seen[way].append((*batch.scenes, *map(str, batch.input_frames)))

        with monkeypatch.context() as patch:
            change_batches(patch, note)
            run(tiny("tokengs", f"training.on_bad_sample={way}"), tmp_path / way)
    assert seen["stop"] == seen["skip"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ("fuzz_files.py", "--count=150", "--seed=7"),
        ("kill_training.py", "--what=evaluation", "--count=8"),
        ("kill_training.py", "--what=packing", "--count=8"),
    ],
    ids=lambda command: " ".join(command),
)
def test_attacks_find_nothing(command: tuple[str, ...]) -> None:
    tool, *options = command
    done = subprocess.run(
        [sys.executable, str(TOOLS / tool), *options],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=1200,
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-3000:]
