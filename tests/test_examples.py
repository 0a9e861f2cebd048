"""The guide's examples: LocusGS in one file computes what ours does, a loop by hand trains."""

import re
import runpy
from importlib import import_module

import pytest
from odd_views import odd_views
from size import ROOT
from small_parts import shaken
from torch.testing import assert_close

import qgs
from qgs.recipe import resolve
from qgs.recipe.recipe import annotated
from qgs.train.training_pass import TrainingPass

FOLDER = ROOT / "docs/examples"
FILE = FOLDER / "nano_locus.py"


@pytest.fixture
def nano(monkeypatch):
    monkeypatch.syspath_prepend(FILE.parent)
    return import_module(FILE.stem)


def test_loss_and_gradients_are_the_frameworks(nano):
    """With weights that differ everywhere from where they start."""
    assert "import qgs" not in FILE.read_text()
    recipe = resolve("tiny/locus.yaml", ["model.renderer.type=qgs/torch"])
    passes = shaken(TrainingPass(recipe, recipe.build_model()).train(), 0.03).float()
    model = passes.model
    p = nano.Weights(
        {name: weight.detach().requires_grad_() for name, weight in model.named_parameters()}
    )
    inputs, targets = (odd_views(2, 8, seed=seed) for seed in (0, 3))

    loss = passes(inputs, targets).total
    loss.backward()
    parts = ((v.images, v.cameras.c2w, v.cameras.intrinsics) for v in (inputs, targets))
    value = nano.loss(p, *parts)
    value.backward()
    assert_close(value, loss)
    gradients = {name: parameter.grad for name, parameter in model.named_parameters()}
    assert_close({name: weight.grad for name, weight in p.items()}, gradients, rtol=1e-3, atol=1e-5)


def test_it_trains(nano, monkeypatch, capsys):
    monkeypatch.setattr(nano, "QUERIES", 16)
    nano.main(8)
    losses = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]
    assert sum(losses[4:]) < sum(losses[:4])


EXAMPLE = FOLDER / "train_by_hand.py"


def test_the_loop_by_hand_trains_and_saves_a_scene(tmp_path, monkeypatch, capsys):
    recipe = tmp_path / "recipe.yaml"
    out = tmp_path / "scene.ply"
    smaller = ["model.queries.count=64", "data.image_size=[32, 32]"]
    recipe.write_text(annotated(resolve("tiny/locus.yaml", smaller)))
    monkeypatch.setattr("sys.argv", [*map(str, (EXAMPLE, recipe, 11, out))])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    first, last = re.findall(r"loss (\S+)", capsys.readouterr().out)
    assert float(last) < float(first)
    assert qgs.load_ply(out).count == 64 * 8
    assert qgs.load(out.with_suffix(".safetensors")).queries.count == 64
