"""Measuring and predicting: samples in turn, workloads, memory of a process of its own, fits."""

import json
import subprocess
import sys
import time
from copy import deepcopy
from dataclasses import asdict
from unittest.mock import Mock, call

import pytest
import torch
from qgs_research.bench import predict
from qgs_research.bench.counting import count
from qgs_research.bench.memory import measure, peak_memory, resident_bytes
from qgs_research.bench.run import in_turn, quartiles
from qgs_research.bench.sweep import fit, parse_axis
from qgs_research.bench.work import Workload, make_task, posed_photos, workload_of
from torch.testing import assert_close

from qgs.geometry.transforms import to_camera
from qgs.recipe import resolve

TOKENGS = "tiny/tokengs.yaml"
SMALL = ["model.width=32", "model.heads=2", "model.queries.count=12"]
MODEST = Workload(views=2, targets=2, size=(16, 24))


def test_quartiles():
    assert [*quartiles((2.0, 8.0, 6.0, 4.0, 10.0)).values()] == [4.0, 6.0, 8.0]


def test_tasks_take_turns():
    tasks, heard = Mock(), []
    columns = in_turn([tasks.a, tasks.b, tasks.c], rounds=3, warmup=1, say=heard.append)
    assert tasks.mock_calls == [call.a(), call.b(), call.c()] * 4
    assert [*map(len, columns)] == [3, 3, 3]
    assert heard == ["warm-up 1 of 1", *(f"round {n} of 3" for n in (1, 2, 3))]


def test_the_recipe_says_how_much_work_there_is():
    recipe = resolve("locus/dl3dv_4096_4views.yaml")
    assert workload_of(recipe) == Workload(views=4, targets=4, size=(256, 448))
    assert workload_of(recipe, views=6, size=(64, 32)) == Workload(6, 4, (64, 32))
    with pytest.raises(ValueError, match=r"no data\.image_size.*--size HxW"):
        workload_of(resolve("locus/overlay.yaml"))


def test_random_photos_have_poses_that_look_at_one_point():
    views, again, others = (posed_photos(2, 5, (48, 64), seed) for seed in (0, 0, 1))
    assert torch.equal(views.images, again.images)
    assert not torch.equal(views.images, others.images)
    point = torch.eye(3)[2].expand(2, 1, 3)
    assert_close(to_camera(point, views.cameras), point[:, None].expand(2, 5, 1, 3))
    assert views.cameras.intrinsics[0, 0].tolist() == [64, 64, 32, 24]


def test_inference_leaves_the_model_alone_and_a_step_trains_every_part():
    recipe = resolve("tiny/locus.yaml", SMALL)
    model = recipe.build_model()
    before = deepcopy(model.state_dict())
    for operation in ("forward", "render"):
        make_task(operation, recipe, model, MODEST)()
        assert not model.training
        assert_close(model.state_dict(), before, rtol=0, atol=0)
        assert all(parameter.grad is None for parameter in model.parameters())
    step = make_task("step", recipe, model, MODEST)
    step()
    step()
    same = [name for name, p in model.named_parameters() if torch.equal(p, before[name])]
    # Softmax ignores what is added to all keys alike; k_norm's bias is that.
    assert [name for name in same if not name.endswith("k_norm.bias")] == []


COMPOSE_FIRST = """
import sys, qgs, runpy
for name in ("mvsplat", "depthsplat", "landmark", "gslrm", "globalsplat"):
    qgs.compose(f"tiny/{name}.yaml", device="meta")
assert not {"torch._dynamo", "sympy"} & sys.modules.keys()
runpy.run_module(sys.argv[2], run_name="__main__")
"""


def executable(file, script):
    """What runs `script` in place of Python."""
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(0o755)
    return str(file)


def test_memory_of_a_fresh_process(tmp_path, monkeypatch):
    """Composing on the meta device, which takes place first, imports nothing of torch's compiler:
    that takes seconds, and initialisers of plug-ins are what might ask for it.
    """
    ballast = torch.zeros(2**26)  # 256 MiB that the other process must not count
    recipe = resolve(TOKENGS, ["model.width=512", "model.heads=8"])
    weights = sum(p.numel() for p in recipe.build_model("meta").parameters()) * 4
    python = executable(tmp_path / "python", f"exec {sys.executable} -c '{COMPOSE_FIRST}' \"$@\"")
    monkeypatch.setattr(sys, "executable", python)
    peak = peak_memory(recipe, "forward", MODEST, threads=1)
    assert weights < peak.peak_bytes - peak.idle_bytes < 3 * weights
    assert peak.idle_bytes < resident_bytes("VmRSS") - ballast.nbytes / 2


def test_what_failed_in_the_process_is_told(tmp_path, monkeypatch):
    recipe = resolve(TOKENGS, SMALL)
    with pytest.raises(ValueError, match="images of 15 x 24 cannot be cut into patches"):
        measure(dict(recipe.tree), "forward", asdict(Workload(2, 2, (15, 24))), threads=1)
    for dies, told in (("exit 1", "ended with 1: ValueError: no"), ("kill -9 $$", "was killed")):
        python = executable(tmp_path / "python", f"echo 'ValueError: no' >&2; {dies}")
        monkeypatch.setattr(sys, "executable", python)
        with pytest.raises(ChildProcessError, match=told):
            peak_memory(recipe, "forward", MODEST, threads=1)


def test_axes_double():
    assert parse_axis("views=2..32").values == (2, 4, 8, 16, 32)
    assert parse_axis("size=24..100").values == (24, 48, 96)
    for text in ["views=2-32", "targets=2..32", "views=0..4", "views=4..7"]:
        with pytest.raises(ValueError, match="AXIS=FIRST"):
            parse_axis(text)


def test_the_exponent_of_a_power_and_its_error():
    found = fit([2, 4, 8, 16], [3 * n**1.5 for n in (2, 4, 8, 16)])
    assert [*asdict(found).values()] == pytest.approx([1.5, 0, 3, 1.5])
    noisy = fit([1, 2, 4], [1, 2, 8])  # logarithms 0, 1, 3: slope 1.5, residuals 1/6, -1/3, 1/6
    assert (noisy.exponent, noisy.error, noisy.last) == pytest.approx((1.5, 12**-0.5, 2))
    assert fit([2, 4], [1, 2]).error is None
    assert fit([2], [1]) is None


def test_counts_follow_shapes():
    shallow = "model.decoder.depth=2", "model.supervision.layers=[1, 2]"
    recipe = resolve(TOKENGS, [*SMALL[:2], *shallow])
    once, twice = (count(recipe, "step", Workload(2, 3, (16, 24), batch=n)) for n in (1, 2))
    weights = sum(p.nbytes for p in recipe.build_model("meta").parameters())
    assert once.parameters * 4 == weights
    assert twice.splats == 2 * once.splats == 2 * 3 * 2 * 256 * 8  # scenes, views, layers
    assert once.peak > 4 * weights, "weights, gradients and two moments"
    assert twice.peak > once.peak


PREDICT = """
import json, sys, time, torch
from qgs_research.bench import predict
predict.timer = time.process_time
torch.set_num_threads(1)
print(json.dumps(predict.predict_recipes([sys.argv[1]], {})))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tokengs", "locus", "mvsplat", "depthsplat"])
def test_near_the_measured(name, monkeypatch):
    """Of processor time, which other processes disturb less."""
    monkeypatch.setattr(predict, "timer", time.process_time)
    torch.set_num_threads(1)
    path = f"tiny/{name}.yaml"
    recipe = resolve(path)
    work = workload_of(recipe)
    # in a fresh process, which holds nothing of earlier tests
    done = subprocess.run([sys.executable, "-c", PREDICT, path], stdout=subprocess.PIPE)
    (found,) = json.loads(done.stdout)
    for operation in ("forward", "step"):
        task = make_task(operation, recipe, recipe.build_model(), work)
        assert found[operation]["seconds"] == pytest.approx(predict._median(task, 7), rel=0.3)
        peak = peak_memory(recipe, operation, work, threads=1).peak_bytes
        assert found[operation]["peak_bytes"] == pytest.approx(peak, rel=0.15)
