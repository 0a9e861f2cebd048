"""docs/examples/nano_locus.py is recipes/tiny/locus.yaml: outputs, renderings, loss, gradients."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from qgs.composer import resolve
from qgs.engine.training_pass import TrainingPass
from qgs.types import Cameras, Gaussians, Views

ROOT = Path(__file__).parents[2]
SIZE = (16, 24)
MAX_LINES = 300
torch.set_num_threads(1)


@pytest.fixture(scope="module")
def nano() -> ModuleType:
    spec = importlib.util.spec_from_file_location("nano", ROOT / "docs/examples/nano_locus.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def trained() -> TrainingPass:
    """The recipe's model with weights that differ everywhere from where they start."""
    recipe = resolve(ROOT / "recipes/tiny/locus.yaml", ["model.renderer.type=qgs/torch"])
    passes = TrainingPass.of(recipe, recipe.build_model())
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in passes.parameters():
            parameter += 0.03 * torch.randn(parameter.shape, generator=generator)
    return passes


def views(count: int, seed: int) -> Views:
    generator = torch.Generator().manual_seed(seed)
    c2w = torch.eye(4).repeat(2, count, 1, 1)
    angle = torch.randn(2, count, 3, generator=generator) * 0.1
    cross = torch.linalg.cross(angle[..., None, :].expand(2, count, 3, 3), c2w[..., :3, :3], dim=-1)
    c2w[..., :3, :3] = torch.linalg.matrix_exp(cross)
    c2w[..., :3, 3] = torch.randn(2, count, 3, generator=generator) * 0.2
    intrinsics = torch.tensor([20.0, 21.0, 11.5, 8.5]).expand(2, count, 4)
    images = torch.rand(2, count, 3, *SIZE, generator=generator)
    return Views(images, Cameras(c2w, intrinsics, SIZE))


def parts(v: Views) -> tuple[torch.Tensor, ...]:
    return v.images, v.cameras.c2w, v.cameras.intrinsics


def weights(nano: ModuleType, passes: TrainingPass) -> Any:
    named = dict(passes.model.named_parameters())
    return nano.Weights({name: p.detach().clone().requires_grad_() for name, p in named.items()})


def test_every_layer_predicts_the_same(nano: ModuleType, trained: TrainingPass) -> None:
    p = weights(nano, trained)
    given = set(p)
    with torch.no_grad():
        expected = trained.model(views(2, 0), layers=[1, 2, 3, 4]).layers
        layers = nano.forward(p, *parts(views(2, 0)))
    assert set(p) == given  # no weight was missing under its name
    assert layers.keys() == expected.keys()
    for number, layer in layers.items():
        state, gaussians = expected[number].state, expected[number].gaussians
        known = {"mu": state["anchor.center"], "rho": state["anchor.raw_radius"], **vars(gaussians)}
        for name, value in layer.items():
            torch.testing.assert_close(value, known[name], rtol=1e-5, atol=1e-5, msg=name)


def test_renderings_are_those_of_the_reference(nano: ModuleType, trained: TrainingPass) -> None:
    cameras = views(2, 3).cameras
    with torch.no_grad():
        gaussians: Gaussians = trained.model(views(2, 0)).gaussians
        expected = trained.model.render(gaussians, cameras).rgb
        image = nano.render(vars(gaussians), 1, cameras.c2w[1, 1], cameras.intrinsics[1, 1], SIZE)
    assert expected[1, 1].std() > 0.01
    torch.testing.assert_close(image, expected[1, 1], rtol=1e-5, atol=1e-5)


def test_the_loss_and_its_gradients(nano: ModuleType, trained: TrainingPass) -> None:
    inputs, targets, p = views(2, 0), views(2, 3), weights(nano, trained)
    expected = trained.train()(inputs, targets).total
    expected.backward()
    value = nano.loss(p, parts(inputs), parts(targets))
    value.backward()
    torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-5)
    for name, parameter in trained.model.named_parameters():
        torch.testing.assert_close(p[name].grad, parameter.grad, rtol=1e-3, atol=1e-5, msg=name)


def test_it_trains(nano: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    nano.main(3)
    losses = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]
    assert len(losses) == 3
    assert losses[-1] < losses[0]


def test_it_can_be_read_in_one_sitting() -> None:
    text = (ROOT / "docs/examples/nano_locus.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_LINES
    assert "import qgs" not in text
