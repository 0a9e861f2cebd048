"""Runs that die are noticed, said so, and leave good weights."""

import signal
from unittest.mock import Mock

import torch
from accelerate import PartialState
from tables import assert_equal, assert_near, must_refuse
from training_runs import resume, run, run_calling, tiny

import qgs
from qgs.checkpoint.model_file import CheckpointFile
from qgs.train.folder import RunFolder
from qgs.train.guard import EMPTY_ALPHA, CollapseError, GoodWeights, SignsOfLife
from qgs.train.training_pass import signs_of

ALIVE = {"alpha": 0.5, "deviation": 0.3, "gradient": 0.1}
PLAIN = ALIVE | {"deviation": 1e-4}
DEAD = dict.fromkeys(ALIVE, 0.0)
INVISIBLE = "model.head.opacity_bias=-20.0"


def observed(*signs):
    """The signs of life after steps with these numbers."""
    found = SignsOfLife()
    for step in signs:
        found.observe(step)
    return found


def test_steps_without_signs_of_life_are_counted():
    for dead, words in (
        (ALIVE | {"alpha": 1e-4}, "empty"),
        (ALIVE | {"gradient": 0.0}, "vanished"),
        (PLAIN, "equal the background"),
    ):
        found = observed(ALIVE, *[dead] * 10)
        assert found.dead == 10
        assert words in found.symptom
    # one living step, and plain images at the start
    assert observed(*[DEAD] * 9, ALIVE, DEAD).dead == 1
    assert observed(*[PLAIN] * 50).dead == 0


def test_a_stray_splat_is_no_sign_of_life():
    rgb = torch.ones(2, 3, 3, 32, 32)
    rgb[0, 0, :, 4:6, 4:6] = 0
    signs = signs_of(Mock(rgb=rgb, alpha=1 - rgb[:, :, :1]), Mock(images=rgb), torch.ones(3))
    assert signs["alpha"] < EMPTY_ALPHA
    assert_near(signs["deviation"], 4 / 32**2)
    symptom = observed(ALIVE, ALIVE | {"deviation": float(signs["deviation"])}).symptom
    assert "equal the background" in symptom


def test_good_weights_are_the_older_of_two_copies_made_before_the_images_got_worse():
    PartialState(cpu=True)  # they ask it whether this process keeps them
    module = torch.nn.Linear(2, 2)
    good = GoodWeights(module)
    for step in range(1, 101):
        torch.nn.init.constant_(module.weight, step)
        good.observe({"psnr": 20.0 if step <= 60 else 10.0})
        if good.due(step, 50):
            good.refresh(step)
    assert [step for step, _ in good.copies] == [50, 60]
    assert not good.due(61, 50)
    step, weights = good.last
    assert step == 50
    assert (weights["weight"] == 50).all()


def test_a_run_stopped_while_it_dies_and_resumed_still_ends_with_good_weights():
    recipe = tiny("tokengs", "training={steps: 40, collapse_window: 10}")
    after = {}

    def die(trainer, stop):
        step = trainer.counters.step
        after[step] = {name: x.clone() for name, x in trainer.model.state_dict().items()}
        if step == 5:
            trainer.model.head.linear.bias.data.fill_(-20)
        if step == 8:
            stop.append(signal.SIGTERM)

    checkpoint = run_calling(die, recipe).folder.checkpoint
    assert CheckpointFile(checkpoint).step == 8  # in doubt: saved as it is
    must_refuse("at step 15: for the last 10 steps", resume, recipe, kind=CollapseError)
    assert CheckpointFile(checkpoint).step == 2
    assert_equal(qgs.load(checkpoint).state_dict(), after[2])


def test_gaussians_invisible_from_the_start_end_a_run_at_the_window_or_its_end():
    options = "training={collapse_window: 10, save_every: 1}"
    for steps, dead in ((400, 10), (3, 3)):
        recipe = tiny("tokengs", INVISIBLE, f"training.steps={steps}", options)
        folder = RunFolder(str(steps))
        words = f"for the last {dead} steps the renderings are empty"
        must_refuse(words, run, recipe, folder.path, kind=CollapseError)
        assert len(folder.history()) == min(steps, 10)
        assert CheckpointFile(folder.checkpoint).step == 0


def test_weights_that_are_not_finite_end_a_run_and_are_never_saved():
    """Those of step 1 give NaN in step 2; those of the last step are seen before they are saved."""

    def break_weights(trainer, stop):
        trainer.model.queries.features.data.fill_(torch.nan)

    features = r"queries\.features"
    for steps, words in ((2, f"step 1: .*{features}"), (1, f"weights are not finite: {features}")):
        recipe = tiny("tokengs", f"training.steps={steps}", "optimizer.warmup=0")
        folder = str(steps)
        must_refuse(words, run_calling, break_weights, recipe, folder, kind=CollapseError)
        kept = qgs.load(RunFolder(folder).checkpoint).state_dict()
        assert all(tensor.isfinite().all() for tensor in kept.values())


def test_one_dead_step_at_the_end_fails_no_run():
    def die_at_the_end(trainer, stop):
        if trainer.counters.step == 3:
            signs = trainer.guard.signs
            signs.observe = lambda numbers: SignsOfLife.observe(signs, DEAD)

    result = run_calling(die_at_the_end, tiny("tokengs"))
    assert CheckpointFile(result.folder.checkpoint).step == 3
