"""Other objectives than one pass: several runs of the model in a step, input views as targets."""

import signal
from pathlib import Path

import pytest
import torch
from qgs_plugintools import Case, checks_for, run_check
from torch import Tensor
from training_runs import TWO, Tiny, first_batch, run, run_calling, same, weights

import qgs
from qgs.composer.registry import load_plugin
from qgs.engine.distributed import StopRequest
from qgs.engine.training import Trainer
from qgs.engine.training_pass import TrainingPass
from qgs.types import Cameras, Views

TERMS = {"alpha_consistency", "depth_consistency"}


def test_terms_of_both_passes_are_recorded(tiny: Tiny, tmp_path: Path, two: None) -> None:
    histories = []
    for render_views in (0, 1):
        recipe = tiny("locus", *TWO, f"training.render_views={render_views}")
        result = run(recipe, tmp_path / str(render_views))
        histories.append(result.folder.history())
    for record, in_parts in zip(*histories, strict=True):
        assert record.keys() >= TERMS | {"mse", "ssim", "visibility", "anchor_visibility"}
        assert all(record[name] > 0 for name in TERMS)
        named = record.keys() - {"step", "seconds", "lr", "loss", "psnr", "alpha", "deviation"}
        assert sum(record[n] for n in named - {"gradient"}) == pytest.approx(record["loss"])
        assert in_parts["loss"] == pytest.approx(record["loss"], rel=1e-4)
    assert qgs.load(result.folder.checkpoint).recipe["objective"]["type"] == "two/two_passes"


def test_it_resumes_and_another_is_refused(tiny: Tiny, tmp_path: Path, two: None) -> None:
    def stop_early(trainer: Trainer, stop: StopRequest) -> None:
        if trainer.step == 1:
            stop.signal = signal.SIGINT  # the next step is the last

    recipe, parts = tiny("tokengs", *TWO), tmp_path / "parts"
    whole = run(recipe, tmp_path / "whole")
    run_calling(stop_early, recipe, parts)
    with pytest.raises(ValueError, match=r"objective\.depth_weight"):
        run(tiny("tokengs", *TWO, "objective.depth_weight=0.5"), parts, resume=True)
    assert same(weights(whole), weights(run(recipe, parts, resume=True)))


def test_input_views_are_judged_too(tiny: Tiny) -> None:
    recipe = tiny("tokengs", "training.judge_inputs=true", "losses.visibility=null")
    model, batch = recipe.build_model().train(), first_batch(recipe)
    both = TrainingPass.of(recipe, model)(batch.inputs, batch.targets)
    plain = TrainingPass(model, recipe.build_losses())
    inputs, targets = batch.inputs, batch.targets
    shares = (inputs, inputs.images.shape[1]), (targets, targets.images.shape[1])
    count = sum(share for _, share in shares)
    parts = [(plain(inputs, views), share / count) for views, share in shares]
    for name, term in both.terms.items():
        wanted = sum(share * outcome.terms[name] for outcome, share in parts)
        torch.testing.assert_close(term, torch.as_tensor(wanted))


def test_views_are_joined_in_order_and_only_with_their_like() -> None:
    def views(count: int, masks: bool = False, width: int = 3) -> Views:
        cameras = Cameras(torch.eye(4).expand(1, count, 4, 4), torch.ones(1, count, 4), (2, width))
        images = torch.rand(1, count, 3, 2, width)
        return Views(images, cameras, images[:, :, :1] if masks else None)

    one, other = views(2, masks=True), views(3, masks=True)
    both = one.joined(other)
    assert both.cameras.shape == (1, 5)
    assert isinstance(both.masks, Tensor)
    assert torch.equal(both.select([2, 3, 4]).masks, other.masks)
    for unlike in (views(2), views(2, masks=True, width=4)):
        with pytest.raises(ValueError, match=r"masks|sizes"):
            one.joined(unlike)


def test_the_objective_of_two_passes_keeps_the_contract(two: None) -> None:
    (component,) = load_plugin("two").plugin.components
    case = Case(component.Config())
    results = [run_check(check, case) for check in checks_for(case, ["core"])]
    assert len(results) >= 6
    assert [result.message for result in results if not result.ok] == []
