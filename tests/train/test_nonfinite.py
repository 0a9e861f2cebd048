"""Steps that are not finite: which tensor was first, and what is saved."""

import json
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from torch.testing import assert_close
from training_runs import same, tiny

import qgs
from qgs.containers import named_tensors
from qgs.data.stream import training_batches
from qgs.train.distributed import make_accelerator
from qgs.train.folder import RunFolder, Saver
from qgs.train.guard import Guard
from qgs.train.incidents import BadTensor, first_bad_tensor
from qgs.train.training import compute_gradients
from qgs.train.training_pass import TrainingPass

GUIDE = Path(__file__).parents[2] / "docs/training.md"
NAN = float("nan")
INF = float("inf")


class Step:
    """One step of a small model, of two batches, that can be broken in many places."""

    def __init__(self):
        recipe = tiny("tokengs", "training.render_views=1")
        self.config = recipe.training
        self.accelerator = make_accelerator("cpu")
        self.model = recipe.build_model().train()
        self.objective = TrainingPass(recipe, self.model)
        self.gradients = partial(
            compute_gradients, self.accelerator, self.objective, recipe.training
        )
        stream = training_batches(recipe.build_data(), recipe.views, 2, seed=0)
        self.batches = [next(stream), next(stream)]
        stream.close()

    def first(self):
        return first_bad_tensor(self.objective, lambda: self.gradients(self.batches))

    def guard(self, folder):
        saver = Saver(self.accelerator, RunFolder(folder), self.model)
        return Guard(self.accelerator, self.objective, saver, self.config, self.gradients)


@pytest.fixture
def step():
    return Step()


def test_a_good_step_shows_nothing_and_keeps_no_hook(step):
    def hooks():
        modules = step.objective.modules()
        return [dict(kept) for m in modules for kept in (m._forward_hooks, m._forward_pre_hooks)]

    step.gradients(step.batches)  # after which the checks of a first forward pass are gone
    before = hooks()
    assert step.first() is None
    assert hooks() == before
    assert not any(p._backward_hooks for p in step.objective.parameters())


def test_a_weight_comes_before_everything_and_data_is_named_with_its_batch(step):
    _, second = step.batches
    for name, tensor in (
        ("targets.cameras.c2w", second.targets.cameras.c2w),
        ("inputs.images", second.inputs.images),
    ):
        tensor.view(-1)[0] = NAN
        assert step.first() == BadTensor(name, f"1 NaN of {tensor.numel()} values", 1)
    name, parameter = list(step.model.named_parameters())[5]
    parameter.data.view(-1)[:2] = torch.tensor([NAN, INF])
    values = f"1 NaN and 1 infinite of {parameter.numel()} values"
    assert step.first() == BadTensor(f"weight model.{name}", values, 0)


def spoiled(function, call, spoil):
    """`function`, of which one call, from 1, returns what `spoil` makes of its result."""
    calls = count(1)

    def spoiling(*arguments):
        result = function(*arguments)
        return spoil(result) if next(calls) == call else result

    return spoiling


def poisoned(x):
    """`x`, with gradients that are not finite."""
    x.register_hook(lambda slope: slope * NAN)
    return x


def test_a_module_is_named_by_its_output_and_the_gradient_of_it(step, monkeypatch):
    layer = step.model.decoder[1]
    spoil = spoiled(layer.cross_attention.forward, 1, poisoned)
    monkeypatch.setattr(layer.cross_attention, "forward", spoil)
    name = "gradient of the output of model.decoder.1.cross_attention"
    assert step.first().tensor.startswith(name)
    # The second call is that of the second batch.
    spoil = spoiled(layer.self_attention.forward, 2, lambda output: output * INF)
    monkeypatch.setattr(layer.self_attention, "forward", spoil)
    found = step.first()
    assert (found.tensor, found.batch) == ("output of model.decoder.1.self_attention", 1)


def test_gaussians_renderings_and_their_gradients_are_named(step, monkeypatch):
    decode = step.model.decode
    render = step.model.render
    scaled = spoiled(decode, 2, lambda g: replace(g, scales=g.scales * INF))
    blank = spoiled(render, 1, lambda r: replace(r, depth=torch.full_like(r.depth, NAN)))
    bent = lambda g, cameras: render(replace(g, quats=poisoned(1 * g.quats)), cameras)  # noqa: E731
    for name, function, tensor in (
        ("render", bent, "gradient of layer 1.gaussians.quats"),
        ("render", blank, "rendering of layer 1.depth"),
        ("decode", scaled, "prediction of layer 2.gaussians.scales"),
    ):
        monkeypatch.setattr(step.model, name, function)
        assert step.first().tensor == tensor


def test_an_incident_can_be_seen_again(step, tmp_path):
    good, bad = step.batches
    bad.targets.images[0, 0, 0, 0, 0] = NAN
    told, in_data = step.guard(tmp_path).look_into(7, step.batches, "loss term mse is nan")
    assert in_data
    place = tmp_path / "incidents/step-7"
    with safe_open(place / "batch.safetensors", "pt") as file:
        shown = {n: json.loads(text) for n, text in file.metadata().items() if "qgs." not in n}
        assert tuple(shown["scenes"]) == good.scenes + bad.scenes
        assert shown["target_frames"][2:] == list(map(list, bad.target_frames))
        for name, own in named_tensors({"inputs": bad.inputs, "targets": bad.targets}):
            assert_close(file.get_tensor(name)[2:], own, rtol=0, atol=0, equal_nan=True)
    example = GUIDE.read_text().split("incidents/step-N")[1].split("```python\n")[1]
    ran = {}
    exec(example.split("```")[0].replace("RUN/incidents", str(tmp_path / "incidents")), ran)
    targets = ran["views"](ran["saved"], "targets")
    assert torch.equal(targets.images[2:].isnan(), bad.targets.images.isnan())
    assert ran["prediction"].gaussians.means.isfinite().all()
    assert same(qgs.load(place / "weights.safetensors").state_dict(), step.model.state_dict())
    report = json.loads((place / "report.json").read_text())
    assert report["symptom"] == "loss term mse is nan"
    assert report["found"][0]["first"]["tensor"] == "targets.images"
    assert report["found"][0]["batches"][1]["scenes"] == list(bad.scenes)
    for part in ("targets.images", "1 NaN of", bad.scenes[0], str(list(bad.target_frames[0]))):
        assert part in told
    assert good.scenes[0] not in told or good.scenes[0] in bad.scenes


def test_the_number_of_saved_incidents_is_bounded(step, tmp_path, monkeypatch):
    monkeypatch.setattr("qgs.train.guard.MAX_SAVED", 1)
    step.gradients = lambda batches: {}
    guard = step.guard(tmp_path)
    told = [guard.look_into(n, step.batches[:1], "loss is nan") for n in range(3)]
    assert len(list((tmp_path / "incidents").iterdir())) == 1
    assert "not saved" in told[1][0]
    assert guard.skipped == guard.incidents == 3
    guard.passed({"alpha": 0.5, "deviation": 0.3, "gradient": 0.1, "psnr": 9.0})
    again = step.guard(tmp_path)
    again.load_state(guard.state())
    assert (again.skipped, again.incidents) == (0, 3)
