"""The learning rate: one cycle against torch's, under a time budget, and any schedule."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from training_runs import Tiny, run, same, weights

from qgs.components import OneCycleAdamW
from qgs.contracts import TrainingConfig


def adamw(steps: int, warmup: int, seconds: float | None = None) -> OneCycleAdamW:
    training = TrainingConfig(steps=steps, seconds=seconds)
    return OneCycleAdamW(OneCycleAdamW.Config(warmup=warmup, learning_rate=4e-4), training)


@pytest.mark.parametrize(("steps", "warmup"), [(40, 10), (100, 2), (7, 3), (500, 400)])
def test_steps_alone_follow_torch(steps: int, warmup: int) -> None:
    schedule = adamw(steps, warmup)
    config = schedule.options
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    reference = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        max_lr=config.learning_rate,
        total_steps=steps,
        pct_start=warmup / steps,
        div_factor=config.initial_divisor,
        final_div_factor=config.final_divisor,
    )
    for step in range(steps):
        assert schedule.learning_rate(step, 0.0) == pytest.approx(
            reference.get_last_lr()[0], rel=1e-9
        )
        optimizer.step()
        if step < steps - 1:
            reference.step()


@pytest.mark.parametrize(
    ("warmup", "seconds", "top"),
    [(10, 20.0, 9), pytest.param(2000, 10.0, 20, id="warm-up cut to a tenth of the time")],
)
def test_a_time_budget_takes_over_when_it_runs_out_first(
    warmup: int, seconds: float, top: int
) -> None:
    schedule = adamw(10_000, warmup, seconds)
    rates = [schedule.learning_rate(step, step * seconds / 200) for step in range(201)]
    assert max(rates) == pytest.approx(schedule.peak)
    assert rates.index(max(rates)) == top
    assert rates[:top] == sorted(rates[:top])
    assert rates[top:] == sorted(rates[top:], reverse=True)
    assert rates[-1] == pytest.approx(schedule.last)


def test_a_linear_warm_up_and_an_end_above_the_first_rate() -> None:
    options = {"warmup_shape": "linear", "initial_divisor": 1000.0, "final_divisor": 0.01}
    config = OneCycleAdamW.Config(warmup=11, learning_rate=1e-4, **options)
    schedule = OneCycleAdamW(config, TrainingConfig(steps=100))
    rates = [schedule.learning_rate(step, 0.0) for step in range(100)]
    assert rates[:11] == pytest.approx([1e-7 + (1e-4 - 1e-7) * step / 10 for step in range(11)])
    assert rates[-1] == pytest.approx(1e-5)


def test_steps_take_over_when_time_is_plenty() -> None:
    timed = adamw(50, 10, seconds=1e6)
    plain = adamw(50, 10)
    for step in range(50):
        assert timed.learning_rate(step, step * 0.1) == pytest.approx(
            plain.learning_rate(step, 0.0), rel=1e-3
        )


@pytest.mark.parametrize("warmup", [0, 1])
def test_without_warm_up_the_peak_comes_first(warmup: int) -> None:
    schedule = adamw(10, warmup)
    assert schedule.learning_rate(0, 0.0) == pytest.approx(schedule.peak)
    assert schedule.learning_rate(9, 0.0) == pytest.approx(schedule.last)


def ramp(step: int) -> float:
    return 2e-3 * min(step, 2) / 2


def halving_cosine(step: int) -> float:
    return 5e-4 * (1 + math.cos(math.pi * step / 4))


@pytest.mark.parametrize(
    ("schedule", "rate"),
    [
        pytest.param(
            "{schedule: linear, values: [0, 2.0e-3], at: [0, 2]}", ramp, marks=pytest.mark.slow
        ),
        ("{schedule: cosine, values: [1.0e-3, 0], at: [0, 4]}", halving_cosine),
        pytest.param(
            "{schedule: steps, values: [1.0e-3, 1.0e-4], at: [3]}",
            lambda s: [1e-3, 1e-4][s >= 3],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_any_schedule_is_a_learning_rate(
    tiny: Tiny, tmp_path: Path, schedule: str, rate: Callable[[int], float]
) -> None:
    recipe = tiny("tokengs", f"optimizer.learning_rate={schedule}", "optimizer.warmup=2000")
    through = run(recipe, tmp_path / "through")
    rates = [record["lr"] for record in through.folder.history()]
    assert rates == pytest.approx([rate(step) for step in range(4)])
    part = (f"optimizer.learning_rate={schedule}", "optimizer.warmup=2000", "training.steps=3")
    run(tiny("tokengs", *part), tmp_path / "run")
    again = run(recipe, tmp_path / "run", resume=True)
    assert [record["lr"] for record in again.folder.history()] == rates
    assert same(weights(again), weights(through))
