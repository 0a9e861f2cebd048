"""Options that change while a model trains: at every step, after a resume, in checkpoints."""

import signal
from pathlib import Path

import pytest
import torch
from training_runs import TWO, Tiny, losses, read_jsonl, run, run_calling, same, weights

import qgs
from qgs.engine.distributed import StopRequest
from qgs.engine.training import Trainer
from qgs.io.checkpoint import CheckpointFile
from qgs.losses import Photometric
from qgs.types import Cameras, Gaussians, LayerPrediction, QueryState, Rendering, Views

SCHEDULED = (
    "model.renderer.dilation={schedule: steps, values: [4, 2, 1], at: [1, 3]}",
    "losses.photometric.ssim_weight={schedule: linear, values: [0.4, 0], at: [0, 4]}",
)


def stop_at_two(trainer: Trainer, stop: StopRequest) -> None:
    if trainer.step == 1:
        stop.signal = signal.SIGINT  # the next step is the last


def test_each_step_has_its_own_numbers(tiny: Tiny, tmp_path: Path) -> None:
    seen = []

    def note(trainer: Trainer, stop: StopRequest) -> None:
        loss = trainer.training_pass.losses["photometric"]
        seen.append((trainer.model.renderer.config.dilation, loss.config.ssim_weight))

    result = run_calling(note, tiny("tokengs", *SCHEDULED), tmp_path / "run")
    # after a step there stand the numbers of the next one
    assert seen == [(2, pytest.approx(0.3)), (2, 0.2), (1, pytest.approx(0.1)), (1, 0)]
    terms = [record["ssim"] for record in result.folder.history()]
    assert terms == sorted(terms, reverse=True)
    assert terms[3] == pytest.approx(terms[0] / 4, rel=0.2), "0.1 of it is left in step 4"
    assert "dilation:" in (tmp_path / "run" / "recipe.yaml").read_text()


def test_an_objective_follows_too(tiny: Tiny, tmp_path: Path, two: None) -> None:
    grows = "objective.alpha_weight={schedule: steps, values: [0, 1], at: [2]}"
    history = run(tiny("tokengs", *TWO, grows), tmp_path / "run").folder.history()
    assert [record["alpha_consistency"] > 0 for record in history] == [False, False, True, True]


def test_a_resumed_run_equals_an_uninterrupted_one(tiny: Tiny, tmp_path: Path) -> None:
    recipe = tiny("locus", *SCHEDULED, "training.evaluate_every=4", "evaluation.scenes=1")
    whole = run(recipe, tmp_path / "whole")
    run_calling(stop_at_two, recipe, tmp_path / "parts")
    parts = run(recipe, tmp_path / "parts", resume=True)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert same(weights(parts), weights(whole))
    judged = [read_jsonl(tmp_path / name / "evaluations.jsonl") for name in ("whole", "parts")]
    assert judged[0] == judged[1]
    other = tiny("locus", *SCHEDULED, "losses.photometric.ssim_weight.values=[0.4, 0.1]")
    with pytest.raises(ValueError, match=r"ssim_weight\.values"):
        run(other, tmp_path / "parts", resume=True)


def test_a_checkpoint_has_the_numbers_of_its_step(tiny: Tiny, tmp_path: Path) -> None:
    result = run_calling(stop_at_two, tiny("tokengs", *SCHEDULED), tmp_path / "run")
    assert result.model.renderer.config.dilation == 2
    model = qgs.load(result.folder.checkpoint)
    assert model.renderer.config.dilation == 2
    qgs.save(model, tmp_path / "again.safetensors")
    assert CheckpointFile(tmp_path / "again.safetensors").step == 2
    assert qgs.load(tmp_path / "again.safetensors").renderer.config.dilation == 2
    fresh = tiny("tokengs", *SCHEDULED).build_model()
    qgs.save(fresh, tmp_path / "fresh.safetensors")
    assert qgs.load(tmp_path / "fresh.safetensors").renderer.config.dilation == 4
    plain = tiny("tokengs").build_model()
    qgs.save(plain, tmp_path / "plain.safetensors")
    assert CheckpointFile(tmp_path / "plain.safetensors").step is None


def test_the_renderer_that_auto_chooses_follows(tiny: Tiny) -> None:
    model = tiny("tokengs", "model.renderer.type=qgs/auto").build_model()
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(1, 9, 3, generator=generator) + torch.tensor([-0.5, -0.5, 1.0])
    quats = torch.tensor([1.0, 0, 0, 0]).expand(1, 9, 4)
    gaussians = Gaussians(means, 0.01 * torch.ones(1, 9, 3), quats, means[..., 0].abs(), means / 2)
    cameras = Cameras(torch.eye(4)[None, None], torch.tensor([[[16.0, 16, 8, 8]]]), (16, 16))
    alphas = []
    for dilation in (0.3, 3.0):
        model.renderer.config = model.renderer.config.model_copy(update={"dilation": dilation})
        alphas.append(model.render(gaussians, cameras).alpha.mean())
    assert alphas[1] > 1.5 * alphas[0]


def test_a_compiled_loss_follows() -> None:
    loss = Photometric(Photometric.Config(ssim_weight=0.0))
    compiled = torch.compile(loss, backend="eager")
    cameras = Cameras(torch.eye(4)[None, None], torch.ones(1, 1, 4), (4, 4))
    views = Views(torch.rand(1, 1, 3, 4, 4), cameras)
    blank = torch.zeros(1, 1, 1, 4, 4)
    rendering = Rendering(torch.rand(1, 1, 3, 4, 4), blank, blank)
    ones = torch.ones(1, 1, 4)
    gaussians = Gaussians(ones[..., :3], ones[..., :3], ones, ones[..., 0], ones[..., :3])
    layer = LayerPrediction(gaussians, QueryState(ones))
    for weight in (1.0, 2.0, 3.0):
        loss.config = Photometric.Config(mse_weight=weight, ssim_weight=0.0)
        for step in (loss, compiled):
            found = step(layer, rendering, views, views)["mse"]
            error = (rendering.rgb - views.images).square().mean()
            torch.testing.assert_close(found, weight * error)
