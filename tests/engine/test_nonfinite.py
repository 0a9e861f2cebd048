"""Steps that are not finite: which tensor was first, and what is saved."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from torch import Tensor
from training_runs import Tiny

import qgs
from qgs.composer import Recipe
from qgs.data.domain import Domain
from qgs.data.stream import training_batches
from qgs.engine.distributed import make_accelerator
from qgs.engine.folder import RunFolder, Saver
from qgs.engine.guard import MAX_SAVED, Guard
from qgs.engine.incidents import BadTensor, first_bad_tensor
from qgs.engine.training import compute_gradients
from qgs.engine.training_pass import TrainingPass
from qgs.types import named_tensors

GUIDE = Path(__file__).parents[2] / "docs/training.md"
NAN, INF = float("nan"), float("inf")


class Step:
    """One step of a small model, that can be broken in many places."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.accelerator = recipe, make_accelerator("cpu")
        self.model = recipe.build_model().train()
        losses = recipe.build_losses()
        self.objective = TrainingPass(self.model, losses, recipe.training.render_views)
        self.gradients = partial(
            compute_gradients, self.accelerator, self.objective, recipe.training
        )
        stream = training_batches(recipe.build_data(), recipe.views, 2, seed=0)
        self.batches = [next(stream), next(stream)]
        stream.close()

    def first(self) -> BadTensor | None:
        return first_bad_tensor(self.objective, lambda: self.gradients(self.batches))

    def first_bad(self) -> BadTensor:
        found = self.first()
        assert found
        return found


@pytest.fixture
def step(tiny: Tiny) -> Step:
    return Step(tiny("tokengs", "training.render_views=1"))


def spoiling(call: int, value: float = NAN) -> Callable[..., Any]:
    """A forward hook that puts `value` into the first tensor of what a module's call returns."""
    calls = []

    def hook(module: torch.nn.Module, arguments: Any, output: Tensor) -> Tensor | None:
        calls.append(module)
        if len(calls) != call:
            return None
        spoiled = output.clone()
        spoiled.view(-1)[0] = value
        return spoiled

    return hook


def test_a_good_step_shows_nothing_and_keeps_no_hook(step: Step) -> None:
    def hooks() -> list[dict]:
        modules = step.objective.modules()
        return [dict(kept) for m in modules for kept in (m._forward_hooks, m._forward_pre_hooks)]

    step.gradients(step.batches)  # after which the checks of a first forward pass are gone
    before = hooks()
    assert step.first() is None
    assert hooks() == before
    assert not any(p._backward_hooks for p in step.objective.parameters())


def test_a_weight_comes_before_everything(step: Step) -> None:
    name, parameter = list(step.model.named_parameters())[5]
    with torch.no_grad():
        parameter.view(-1)[:2] = torch.tensor([NAN, INF])
    values = f"1 NaN and 1 infinite of {parameter.numel()} values"
    assert step.first() == BadTensor(f"weight model.{name}", values, 0)


@pytest.mark.parametrize(("side", "field"), [("inputs", "images"), ("targets", "cameras.c2w")])
def test_data_is_named_with_its_batch(step: Step, side: str, field: str) -> None:
    views = getattr(step.batches[1], side)
    tensor = views.images if field == "images" else views.cameras.c2w
    tensor.view(-1)[0] = NAN
    found = step.first()
    assert found == BadTensor(f"{side}.{field}", f"1 NaN of {tensor.numel()} values", 1)


def test_a_module_is_named_by_its_output(step: Step) -> None:
    layer = step.model.decoder[2]
    layer.self_attention.register_forward_hook(spoiling(call=2))
    found = step.first_bad()
    assert found.tensor == "output of model.decoder.2.self_attention"
    assert found.batch == 1, "its second call is that of the second batch"


def test_a_layer_and_its_gaussians_are_named(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    decode, calls = step.model.decode, []

    def broken(state: Any) -> Any:
        gaussians = decode(state)
        calls.append(state)
        return replace(gaussians, scales=gaussians.scales * INF) if len(calls) == 2 else gaussians

    monkeypatch.setattr(step.model, "decode", broken)
    assert step.first_bad().tensor == "prediction of layer 4.gaussians.scales"


def test_a_rendering_is_named(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    render = step.model.render
    blank = lambda *a: replace(render(*a), depth=torch.full_like(render(*a).depth, NAN))  # noqa: E731
    monkeypatch.setattr(step.model, "render", blank)
    assert step.first_bad().tensor == "rendering of layer 2.depth"


class Poison(torch.autograd.Function):
    """The identity, with gradients that are not finite."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> Tensor:
        return slopes[0] * NAN


def test_gradients_are_named_backwards(step: Step, monkeypatch: pytest.MonkeyPatch) -> None:
    layer = step.model.decoder[1]
    handle = layer.cross_attention.register_forward_hook(lambda m, a, out: Poison.apply(out))
    found = step.first_bad()
    handle.remove()
    assert found.tensor.startswith("gradient of the output of model.decoder.1.cross_attention")
    render = step.model.render

    def poisoned(gaussians: Any, cameras: Any) -> Any:
        return render(replace(gaussians, quats=Poison.apply(gaussians.quats)), cameras)

    monkeypatch.setattr(step.model, "render", poisoned)
    assert step.first_bad().tensor == "gradient of layer 2.gaussians.quats"


def guard_of(step: Step, folder: Path) -> Guard:
    saver = Saver(step.accelerator, RunFolder(folder), step.model, Domain())
    return Guard(step.accelerator, step.objective, saver, step.recipe.training, step.gradients)


def test_an_incident_can_be_seen_again(step: Step, tmp_path: Path) -> None:
    step.batches[1].targets.images[0, 0, 0, 0, 0] = NAN
    told, in_data = guard_of(step, tmp_path).look_into(7, step.batches, "loss term mse is nan")
    assert in_data
    place = tmp_path / "incidents" / "step-7"
    names = {"batch.safetensors", "weights.safetensors", "report.json"}
    assert {path.name for path in place.iterdir()} == names
    bad = step.batches[1]
    with safe_open(place / "batch.safetensors", "pt") as file:
        shown = {n: json.loads(text) for n, text in file.metadata().items() if "qgs." not in n}
        assert tuple(shown["scenes"]) == step.batches[0].scenes + bad.scenes
        assert shown["target_frames"][2:] == list(map(list, bad.target_frames))
        own = dict(named_tensors({"inputs": bad.inputs, "targets": bad.targets}))
        assert set(file.keys()) == own.keys()
        for name, tensor in own.items():
            torch.testing.assert_close(
                file.get_tensor(name)[2:], tensor, rtol=0, atol=0, equal_nan=True
            )
    example = GUIDE.read_text(encoding="utf-8").split("incidents/step-N")[1].split("```python\n")[1]
    ran: dict[str, Any] = {}
    exec(example.split("```")[0].replace("RUN/incidents", str(tmp_path / "incidents")), ran)
    saved = ran["views"](ran["saved"], "targets")
    assert torch.equal(saved.images[2:].isnan(), bad.targets.images.isnan())
    assert ran["prediction"].gaussians.means.isfinite().all()
    weights = qgs.load(place / "weights.safetensors").state_dict()
    assert all(torch.equal(t, weights[name]) for name, t in step.model.state_dict().items())
    report = json.loads((place / "report.json").read_text())
    assert report["symptom"] == "loss term mse is nan"
    assert report["found"][0]["first"]["tensor"] == "targets.images"
    assert report["found"][0]["batches"][1]["scenes"] == list(bad.scenes)
    for part in ("targets.images", "1 NaN of", bad.scenes[0], str(list(bad.target_frames[0]))):
        assert part in told
    assert step.batches[0].scenes[0] not in told or step.batches[0].scenes[0] in bad.scenes


def test_the_number_of_saved_incidents_is_bounded(step: Step, tmp_path: Path) -> None:
    step.gradients = lambda batches: {}
    guard, count = guard_of(step, tmp_path), MAX_SAVED + 2
    told = [guard.look_into(n, step.batches[:1], "loss is nan") for n in range(count)]
    assert len(list((tmp_path / "incidents").iterdir())) == MAX_SAVED
    assert "not saved" in told[-1][0]
    assert guard.skipped == guard.incidents == count
    guard.passed({"alpha": 0.5, "deviation": 0.3, "gradient": 0.1, "psnr": 9.0})
    assert (guard.skipped, guard.incidents) == (0, count)
    again = guard_of(step, tmp_path)
    again.load_state(guard.state())
    assert (again.skipped, again.incidents) == (0, count)
