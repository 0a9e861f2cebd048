"""Measuring: samples in turn, workloads from recipes, memory of a process of its own."""

import math
from pathlib import Path

import pytest
import torch
from qgs_bench.memory import peak_memory, resident_bytes
from qgs_bench.run import in_turn, quartiles
from qgs_bench.work import Operation, Workload, make_task, posed_photos, workload_of

from qgs.composer import resolve
from qgs.geometry.transforms import to_camera, to_pixels

RECIPES = Path(__file__).parents[3] / "recipes"
SMALL = ["model.width=32", "model.heads=2", "model.queries.count=12"]
MODEST = Workload(views=2, targets=2, size=(16, 24))


def test_quartiles() -> None:
    assert [*quartiles((2.0, 8.0, 6.0, 4.0, 10.0)).values()] == [4.0, 6.0, 8.0]


def test_tasks_take_turns() -> None:
    calls: list[str] = []
    heard: list[str] = []
    tasks = [lambda name=name: calls.append(name) for name in "abc"]
    columns = in_turn(tasks, rounds=3, warmup=1, say=heard.append)
    assert calls == ["a", "b", "c"] * 4
    assert [len(column) for column in columns] == [3, 3, 3]
    assert heard == ["warm-up 1 of 1", *(f"round {n} of 3" for n in (1, 2, 3))]


def test_the_recipe_says_how_much_work_there_is() -> None:
    recipe = resolve(RECIPES / "locus/dl3dv_4096_4views.yaml")
    assert workload_of(recipe) == Workload(views=4, targets=4, size=(256, 448))
    assert workload_of(recipe, views=6, size=(64, 32)).size == (64, 32)
    without_data = resolve(RECIPES / "locus/overlay.yaml")
    with pytest.raises(ValueError, match=r"no data\.image_size.*--size HxW"):
        workload_of(without_data)
    assert workload_of(without_data, size=(8, 8)).views == without_data.views.inputs


def test_random_photos_have_poses_that_look_at_one_point() -> None:
    views = posed_photos(2, 5, (48, 64), seed=0)
    assert torch.equal(views.cameras.c2w[0, 0], torch.eye(4))
    seen = to_camera(torch.tensor([0.0, 0.0, 1.0]).expand(2, 1, 3), views.cameras)
    torch.testing.assert_close(seen[..., 2], torch.ones(2, 5, 1))
    pixels = to_pixels(seen, views.cameras.intrinsics)
    torch.testing.assert_close(pixels, torch.tensor([32.0, 24.0]).expand(2, 5, 1, 2))
    assert torch.equal(views.images, posed_photos(2, 5, (48, 64), seed=0).images)
    assert not torch.equal(views.images, posed_photos(2, 5, (48, 64), seed=1).images)


def test_inference_leaves_the_model_alone_and_a_step_trains_every_part() -> None:
    recipe = resolve(RECIPES / "tiny/locus.yaml", SMALL)
    model = recipe.build_model()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    for operation in ("forward", "render"):
        make_task(operation, recipe, model, MODEST)()
        assert not model.training
        assert all(torch.equal(before[name], tensor) for name, tensor in model.state_dict().items())
        assert all(parameter.grad is None for parameter in model.parameters())
    step = make_task("step", recipe, model, MODEST)
    step()
    step()
    same = [name for name, p in model.named_parameters() if torch.equal(p, before[name])]
    # Softmax ignores what is added to all keys alike; k_norm's bias is that.
    assert [name for name in same if not name.endswith("k_norm.bias")] == []


@pytest.mark.parametrize(
    ("operation", "least", "most"),
    [("forward", 1, 3), pytest.param("step", 4, math.inf, marks=pytest.mark.slow)],
)
def test_memory_of_a_fresh_process(operation: Operation, least: float, most: float) -> None:
    """A step holds weights, gradients and two moments."""
    ballast = torch.zeros(2**26)  # 256 MiB that the other process must not count
    recipe = resolve(RECIPES / "tiny/tokengs.yaml", ["model.width=512", "model.heads=8"])
    weights = sum(p.numel() for p in recipe.build_model("meta").parameters()) * 4
    peak = peak_memory(recipe, operation, MODEST, threads=1)
    assert least * weights < peak.peak_bytes - peak.idle_bytes < most * weights
    assert peak.idle_bytes < resident_bytes("VmRSS") - ballast.nbytes / 2


def test_what_failed_in_the_process_is_told() -> None:
    recipe = resolve(RECIPES / "tiny/tokengs.yaml", SMALL)
    uneven = Workload(views=2, targets=2, size=(15, 24))
    with pytest.raises(ChildProcessError, match="images of 15 x 24 cannot be cut into patches"):
        peak_memory(recipe, "forward", uneven, threads=1)
