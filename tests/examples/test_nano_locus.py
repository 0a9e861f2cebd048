"""docs/examples/nano_locus.py is recipes/tiny/locus.yaml: its loss and gradients."""

from importlib import import_module
from pathlib import Path

import pytest
import torch
from odd_views import odd_views

from qgs.recipe import resolve
from qgs.train.training_pass import TrainingPass

FILE = Path(__file__).parents[2] / "docs/examples/nano_locus.py"


@pytest.fixture
def nano(monkeypatch):
    monkeypatch.syspath_prepend(FILE.parent)
    return import_module(FILE.stem)


def test_loss_and_gradients_are_the_frameworks(nano):
    """With weights that differ everywhere from where they start."""
    recipe = resolve("tiny/locus.yaml", ["model.renderer.type=qgs/torch"])
    passes = TrainingPass(recipe, recipe.build_model()).train()
    model = passes.model
    with torch.no_grad():
        for parameter in passes.parameters():
            parameter += 0.03 * torch.randn(parameter.shape)
    p = nano.Weights(
        {name: weight.detach().requires_grad_() for name, weight in model.named_parameters()}
    )
    inputs, targets = (odd_views(2, 8, 16, seed=seed) for seed in (0, 3))

    loss = passes(inputs, targets).total
    loss.backward()
    parts = ((v.images, v.cameras.c2w, v.cameras.intrinsics) for v in (inputs, targets))
    value = nano.loss(p, *parts)
    value.backward()
    torch.testing.assert_close(value, loss)
    gradients = {name: parameter.grad for name, parameter in model.named_parameters()}
    found = {name: weight.grad for name, weight in p.items()}
    torch.testing.assert_close(found, gradients, rtol=1e-3, atol=1e-5)


def test_it_trains(nano, monkeypatch, capsys):
    monkeypatch.setattr(nano, "QUERIES", 16)
    nano.main(8)
    losses = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]
    assert sum(losses[4:]) < sum(losses[:4])


def test_it_can_be_read_in_one_sitting():
    text = FILE.read_text()
    assert len(text.splitlines()) <= 320
    assert "import qgs" not in text
