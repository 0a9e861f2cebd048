"""Counting from shapes: the bytes of real tensors, what a training needs, which batch fits."""

from pathlib import Path

import pytest
import torch
from qgs_bench.counting import count
from qgs_bench.memory import peak_memory
from qgs_bench.predict import largest_batch, need_of, parse_bytes
from qgs_bench.work import Workload, workload_of

from qgs.composer import resolve

RECIPES = Path(__file__).parents[3] / "recipes"
SMALL = ["model.width=32", "model.heads=2", "model.queries.count=12"]
MODEST = Workload(views=2, targets=2, size=(16, 24))


SLOW = [pytest.param(n, marks=pytest.mark.slow) for n in ("tokengs", "ellipsoid", "gslrm", "c3g")]


@pytest.mark.parametrize("name", ["locus", "globalsplat", *SLOW])
def test_shapes_alone_count_the_bytes_of_real_tensors(name: str) -> None:
    recipe = resolve(RECIPES / f"tiny/{name}.yaml")
    work = Workload(views=2, targets=2, size=(32, 48), batch=2)
    found = count(recipe, "step", work)
    assert found == count(recipe, "step", work, fake=False)
    assert found.weights == sum(
        t.nbytes for t in recipe.build_model("meta").state_dict().values()
    ) or name in ("c3g", "globalsplat")
    assert found.moments >= 2 * found.gradients > found.weights
    assert found.weights + found.moments < found.peak


@pytest.mark.slow
def test_bf16_keeps_less_and_a_forward_pass_keeps_nothing() -> None:
    recipe = resolve(RECIPES / "tiny/locus.yaml")
    work = Workload(2, 2, (64, 64), batch=4)
    half = Workload(2, 2, (64, 64), batch=4, precision="bf16")
    assert count(recipe, "step", half).peak < count(recipe, "step", work).peak
    forward = count(recipe, "forward", work)
    assert (forward.kept, forward.moments, forward.gradients) == ({}, 0, 0)


def test_counting_leaves_everything_as_it_was() -> None:
    """Kernels run again, arrays have numbers again, modules move again."""
    before = torch.Tensor.numpy, torch.from_numpy, torch.nn.Module.to
    recipe = resolve(RECIPES / "tiny/locus.yaml", SMALL)
    count(recipe, "step", MODEST)
    assert (torch.Tensor.numpy, torch.from_numpy, torch.nn.Module.to) == before
    found = [count(recipe, "step", MODEST, fake=fake).peak for fake in (False, True, False)]
    assert len({*found}) == 1


def test_what_cannot_be_counted_is_told() -> None:
    recipe = resolve(RECIPES / "tiny/tokengs.yaml", SMALL)
    with pytest.raises(ValueError, match=r"cannot be cut into patches.*measure it with --memory"):
        count(recipe, "step", Workload(views=2, targets=2, size=(15, 24)))


@pytest.mark.slow
def test_a_training_needs_more_than_a_step() -> None:
    plain = need_of(resolve(RECIPES / "tiny/tokengs.yaml", SMALL), MODEST)
    more = ["training.ema=0.99", "training.accumulate=3"]
    rich = need_of(resolve(RECIPES / "tiny/tokengs.yaml", [*SMALL, *more]), MODEST)
    assert rich.step == plain.step
    weights = plain.step["weights"]
    assert plain.besides["two copies of good weights"] == 2 * weights
    assert rich.besides["moving average of the weights"] == weights
    images = 4 * 3 * 16 * 24 * 4
    assert plain.besides["batches on their way"] == images
    assert rich.besides["batches on their way"] == 3 * images
    assert rich.total > plain.total + 2 * weights
    on_gpu = need_of(
        resolve(RECIPES / "tiny/tokengs.yaml", SMALL), Workload(2, 2, (16, 24), device="cuda")
    )
    assert "two copies of good weights" not in on_gpu.besides


@pytest.mark.parametrize(
    ("need", "limit", "expected"),
    [
        (lambda b: 100 + 10 * b, 155, 5),
        (lambda b: max(100 + 10 * b, 50 + 40 * b), 1000, 23),
        (lambda b: 100, 155, 2**16),
        (lambda b: 1000, 155, 0),
        (lambda b: 100 + 10 * b, 110, 1),
        (lambda b: 100 + 10 * b, 120, 2),
    ],
)
def test_the_largest_batch(need: object, limit: int, expected: int) -> None:
    asked: list[int] = []
    assert largest_batch(lambda b: asked.append(b) or need(b), limit) == expected  # type: ignore[operator]
    assert len(asked) <= 8


def test_sizes_of_memory() -> None:
    assert parse_bytes("24GB") == 24 * 10**9
    assert parse_bytes("1.5 GiB") == 3 * 2**29
    assert parse_bytes("512MB") == 512 * 10**6
    for wrong in ("24", "24 G", "GB", "24gb", "1iB"):
        with pytest.raises(ValueError, match="--within must be a size such as 24GB"):
            parse_bytes(wrong)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "batch"), [("tokengs", 2), ("locus", 8), ("globalsplat", 8)])
def test_the_prediction_is_near_the_peak_of_a_process(name: str, batch: int) -> None:
    recipe = resolve(RECIPES / f"tiny/{name}.yaml")
    work = workload_of(recipe, batch=batch)
    predicted = sum(need_of(recipe, work).step.values())
    measured = peak_memory(recipe, "step", work, threads=1).peak_bytes
    assert predicted == pytest.approx(measured, rel=0.15)
