"""Evaluations while a model trains."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image
from training_runs import Tiny, read_jsonl

from qgs.composer import Recipe
from qgs.data.evaluation import evaluation_samples
from qgs.drawing.images import rgb_picture
from qgs.engine.distributed import make_accelerator
from qgs.engine.evaluation import evaluate
from qgs.engine.parameters import MovingAverage
from qgs.engine.periodic import PeriodicEvaluation
from qgs.engine.tracking import Trackers


@pytest.fixture
def recipe(tiny: Tiny) -> Recipe:
    return tiny("locus", "evaluation.scenes=3")


def test_weights_and_their_average_are_judged_side_by_side(recipe: Recipe, tmp_path: Path) -> None:
    model, told = recipe.build_model().train(), Mock(spec=Trackers)
    average = MovingAverage(model, 0.5)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1.5)
    periodic = PeriodicEvaluation(make_accelerator("cpu"), recipe, model, average, tmp_path, told)
    random = torch.get_rng_state()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    for step in (5, 10, 10):
        periodic.run(step)
    assert model.training
    assert torch.equal(torch.get_rng_state(), random)
    assert all(torch.equal(t, before[name]) for name, t in model.state_dict().items())
    records = read_jsonl(tmp_path / "evaluations.jsonl")
    assert [(r["step"], r["weights"]) for r in records] == [
        (step, weights) for step in (5, 10) for weights in ("raw", "ema")
    ]
    raw, ema = records[-2:]
    assert raw["scores"]["psnr"] == evaluate(model, recipe).summary()["model"]["psnr"]
    with average.applied():
        assert ema["scores"]["psnr"] == evaluate(model, recipe).summary()["model"]["psnr"]
    assert raw["scores"]["psnr"] != ema["scores"]["psnr"]
    assert raw["scenes"] == raw["scenes_in_protocol"] == 3
    logged = [call.args[0] for call in told.log.call_args_list]
    numbers = {name: score for scores in logged for name, score in scores.items()}
    assert numbers["evaluation/raw/psnr"] == raw["scores"]["psnr"]
    assert numbers["evaluation/ema/ssim"] == ema["scores"]["ssim"]
    assert told.picture.call_args_list[0].args[::2] == ("evaluation", 5)


def test_a_picture_shows_inputs_truth_rendering_and_depth(recipe: Recipe, tmp_path: Path) -> None:
    model = recipe.build_model().train()
    cpu = make_accelerator("cpu")
    PeriodicEvaluation(cpu, recipe, model, None, tmp_path, Trackers(())).run(5)
    picture = np.asarray(Image.open(tmp_path / "pictures" / "step-5.png"))
    side, gap, columns, rows = 16, 4, 5, 3
    assert picture.shape == (rows * (side + gap) - gap, columns * (side + gap) - gap, 3)
    scene = recipe.build_data().scenes("test")[0]
    samples = evaluation_samples(recipe.build_data(), recipe.views, recipe.evaluation)
    first_input = scene.images([samples[0].input_frames[0]])[0]
    np.testing.assert_array_equal(picture[:side, :side], rgb_picture(first_input))
    render = picture[:side, 3 * (side + gap) : 3 * (side + gap) + side]
    truth = picture[:side, 2 * (side + gap) : 2 * (side + gap) + side]
    assert render.std() > 0
    assert not np.array_equal(render, truth)
