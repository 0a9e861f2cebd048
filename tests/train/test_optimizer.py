"""Learning rates; which parameters decay, learn slower or stay; the moving average."""

import re

import pytest
import torch
from refusals import refused
from tables import assert_near, names_in, rows
from torch import nn
from training_runs import assert_equal_runs, column, parts_of, resume, run, tiny

from qgs.contracts import TrainingConfig
from qgs.recipe import resolve
from qgs.tokengs import OneCycleAdamW
from qgs.train.state import MovingAverage, make_optimizer


def adamw(steps, warmup, seconds=None, **options):
    config = OneCycleAdamW.Config(warmup=warmup, learning_rate=4e-4, **options)
    return OneCycleAdamW(config, TrainingConfig(steps=steps, seconds=seconds))


def test_the_rates_of_steps_alone_and_with_plenty_of_time_follow_torch():
    for steps, warmup in ((40, 10), (100, 2), (7, 3), (50, 40)):
        schedule = adamw(steps, warmup)
        timed = adamw(steps, warmup, seconds=1e6)
        optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))])
        reference = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            4e-4,
            steps,
            pct_start=warmup / steps,
            div_factor=schedule.config.initial_divisor,
            final_div_factor=schedule.config.final_divisor,
        )
        for step in range(steps):
            (rate,) = reference.get_last_lr()
            assert_near(schedule.learning_rate(step, 0.0), rate, rtol=1e-9)
            assert_near(timed.learning_rate(step, step * 0.1), rate, rtol=1e-3)
            optimizer.step()
            reference.step()


def test_a_time_budget_takes_over_when_it_runs_out_first():
    """A warm-up of 2,000 steps is cut to a tenth of the time."""
    for warmup, seconds, top in ((10, 20.0, 9), (2000, 10.0, 20)):
        schedule = adamw(10_000, warmup, seconds)
        rates = [schedule.learning_rate(step, step * seconds / 200) for step in range(201)]
        assert max(rates) == rates[top] == pytest.approx(4e-4)
        assert rates[:top] == sorted(rates[:top])
        assert rates[top:] == sorted(rates[top:], reverse=True)
        assert_near(rates[-1], 1.6e-8)


def test_a_linear_warm_up_none_and_an_end_above_the_first_rate():
    schedule = adamw(100, 11, warmup_shape="linear", initial_divisor=1000.0, final_divisor=0.01)
    rates = [schedule.learning_rate(step, 0.0) for step in range(100)]
    assert_near(rates[:11], [4e-7 + (4e-4 - 4e-7) * step / 10 for step in range(11)])
    assert_near(rates[-1], 4e-5)
    for warmup in (0, 1):
        schedule = adamw(10, warmup)
        assert_near(schedule.learning_rate(0, 0.0), 4e-4)
        assert_near(schedule.learning_rate(9, 0.0), 1.6e-8)


def test_every_trained_parameter_decays_but_the_head_and_1d_ones():
    recipe = tiny("locus", "optimizer.weight_decay=0.1")
    model = recipe.build_model()
    model.queries.features.requires_grad_(False)
    trained = {p: n for n, p in model.named_parameters() if p.requires_grad}
    for module in (model, nn.ModuleDict({"model": model})):
        optimizer = make_optimizer(module, recipe.build_optimizer(), recipe.rate_factors(module))
        assert [group["weight_decay"] for group in optimizer.param_groups] == [0.1, 0.0]
        assert optimizer.defaults["betas"] == (0.9, 0.95)
        decaying, others = ([trained[p] for p in g["params"]] for g in optimizer.param_groups)
        assert sorted(decaying + others) == sorted(trained.values())
        expected = {n for p, n in trained.items() if p.ndim == 1 or n.startswith("head.")}
        assert set(others) == expected


PATTERNS = r"""
encoder = encoder\..*
encoder.* = encoder\..*
model.queries = queries\..*
queries.features = queries\.features
decoder.*.cross_attention = decoder\.\d\.cross_attention\..*
decoder.[01] = decoder\.[01]\..*
decoder.cross_attention = decoder\.\d\.cross_attention\..*
decoder.layers.[01].cross_attention = decoder\.[01]\.cross_attention\..*
decoder.refinement = refinements\..*
model.decoder.layers.2.refinement = refinements\..*
decoder.*.*_scale.gamma = decoder\.\d\.\w+_scale\.gamma
"""
"""A pattern, and what all names of its parameters match."""


def test_a_pattern_names_a_part_and_all_below_it():
    plain = tiny("locus", "model.decoder.depth=4")
    model = plain.build_model("meta")
    for pattern, expected in rows(PATTERNS, " = "):
        recipe = resolve(plain.tree, [f'optimizer.parts={{"{pattern}": 0.5}}'])
        wanted = {name for name, _ in model.named_parameters() if re.fullmatch(expected, name)}
        for module in (model, nn.ModuleDict({"model": model})):
            factors = recipe.rate_factors(module)
            found = {n.removeprefix("model.") for n, factor in factors.items() if factor == 0.5}
            assert found == wanted != set(), pattern


def test_a_pattern_that_matches_nothing_ends_the_start(here):
    pattern = "decoder.1.self_atention"
    problem = refused(tiny("locus", f'optimizer.parts={{"{pattern}": 0.1}}'), by=run)
    assert problem.file[:5] == "--set"
    assert problem.option == f"optimizer.parts.{pattern}"
    assert "`decoder.1.self_attention`" in problem.fix
    assert not names_in(here)


def test_a_factor_scales_the_step_and_frozen_parts_stay_and_are_not_remembered():
    """The first step of AdamW without decay is the learning rate, whatever the gradient.

    The last pattern that matches counts.
    """
    options = "warmup: 0, weight_decay: 0.0, learning_rate: 4.0e-3"
    parts = '{"*": 0.5, encoder: 0, "decoder.*.feed_forward": 0, head: 1, head.linear.bias: 2}'
    recipe = tiny("tokengs", "training.steps=1", f"optimizer={{{options}, parts: {parts}}}")
    before = recipe.build_model().state_dict()
    result = run(recipe)
    moments = {name for name, values in parts_of()["moments"].items() if values}
    factors = {"queries.features": 0.5, "head.linear.weight": 1, "head.linear.bias": 2}
    for name, parameter in result.model.named_parameters():
        step = float((parameter.detach() - before[name]).abs().max())
        if name in factors:
            assert_near(step, 4e-3 * factors[name], rtol=1e-2)
        frozen = name.startswith("encoder.") or ".feed_forward." in name
        assert (step == 0) == frozen, name
        assert (parameter.grad is None) == frozen, name
        assert (f"model.{name}" in moments) != frozen, name


PLAIN = """
from torch.optim import Adafactor
from qgs.contracts import Optimizer, Plugin

class Plain(Optimizer):
    \"\"\"Adafactor at one rate.\"\"\"
    name = "plain"
    def build(self, groups):
        return Adafactor(groups, lr=self.config.learning_rate)

plugin = Plugin("plain", 1, (Plain,))
"""


def test_a_plugin_adds_an_optimiser_by_one_class(install):
    """With moments of several shapes; some parameters get no gradient, and have none."""
    install("plain", "plain", PLAIN)
    recipe = tiny(
        "locus",
        "model.decoder.cross_attention.bandwidth=fixed",
        "model.centers.type=locus/anchor_offset",
        "plugins=[rooms, locus, plain]",
        "optimizer={type: plain/plain, learning_rate: 0.02, parts: {encoder: 0, head: 0.5}}",
    )
    assert column(run(recipe).folder.history(), "lr") == [0.02] * 3
    run(resolve(recipe.tree, ["training.steps=2"]), "halves")
    assert resume(recipe, "halves").resumed_at == 2
    assert_equal_runs("run", "halves")
    moments = parts_of()["moments"]
    assert set().union(*moments.values()) == {"step", "row_var", "col_var", "variance"}
    assert not [name for name, values in moments.items() if "raw_radius" in name and values]


def test_the_average_is_the_weighted_mean_of_all_weights_so_far():
    """Of a weight that is shared, and a counter."""
    linear = nn.Linear(3, 2, bias=False)
    model = nn.Sequential(linear, linear)
    model.register_buffer("seen", torch.tensor(0))
    average = MovingAverage(model, 0.9)
    expected = linear.weight.detach().clone()
    for _ in range(5):
        weight = torch.randn(2, 3)
        linear.weight.data.copy_(weight)
        model.seen.add_(1)
        expected = 0.9 * expected + 0.1 * weight
        average.update_parameters(model)
    expected = {"0.weight": expected, "seen": torch.tensor(5)}
    torch.testing.assert_close(average.state(), expected)  # shared weights once
