"""Which parameters decay, learn slower or stay; an optimiser of a plugin; the moving average."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from refusals import refused
from torch import nn
from training_runs import Tiny, run, same, weights

from qgs.composer import resolve
from qgs.engine.folder import read_state
from qgs.engine.parameters import MovingAverage, make_optimizer, parameter_groups


def undecayed_names(module: nn.Module) -> set[str]:
    groups = parameter_groups(module, {n: 1.0 for n, _ in module.named_parameters()})
    chosen = {id(p) for group in groups if not group["decays"] for p in group["params"]}
    return {name for name, p in module.named_parameters() if id(p) in chosen}


@pytest.mark.parametrize("name", ["tokengs", "locus"])
def test_the_head_and_1d_parameters_do_not_decay(tiny: Tiny, name: str) -> None:
    model = tiny(name).build_model("meta")
    expected = {n for n, p in model.named_parameters() if p.ndim == 1 or n.startswith("head.")}
    assert undecayed_names(model) == expected
    assert undecayed_names(nn.ModuleDict({"model": model})) == {f"model.{n}" for n in expected}


def test_every_trained_parameter_is_in_one_group(tiny: Tiny) -> None:
    recipe = tiny("locus", "optimizer.weight_decay=0.1")
    model = recipe.build_model()
    model.queries.features.requires_grad_(False)
    optimizer = make_optimizer(model, recipe.build_optimizer(), recipe.rate_factors(model))
    trained = [id(p) for p in model.parameters() if p.requires_grad]
    grouped = [id(p) for group in optimizer.param_groups for p in group["params"]]
    assert sorted(grouped) == sorted(trained)
    assert [group["weight_decay"] for group in optimizer.param_groups] == [0.1, 0.0]
    assert optimizer.defaults["betas"] == (0.9, 0.95)


def test_decay_shrinks_only_what_decays(tiny: Tiny) -> None:
    recipe = tiny("tokengs", "optimizer.weight_decay=0.5", "optimizer.learning_rate=0.1")
    model = recipe.build_model()
    optimizer = make_optimizer(model, recipe.build_optimizer(), recipe.rate_factors(model))
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    kept = undecayed_names(model)
    for name, parameter in model.named_parameters():
        factor = 1.0 if name in kept else 1 - 0.1 * 0.5
        torch.testing.assert_close(parameter.detach(), before[name] * factor)


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("encoder", r"encoder\..*"),
        ("encoder.*", r"encoder\..*"),
        ("model.queries", r"queries\..*"),
        ("queries.features", r"queries\.features"),
        ("decoder.*.cross_attention", r"decoder\.\d\.cross_attention\..*"),
        ("decoder.[01]", r"decoder\.[01]\..*"),
        ("decoder.cross_attention", r"decoder\.\d\.cross_attention\..*"),
        ("decoder.layers.[01].cross_attention", r"decoder\.[01]\.cross_attention\..*"),
        ("decoder.refinement", r"refinements\..*"),
        ("model.decoder.layers.2.refinement", r"refinements\..*"),
        ("decoder.*.*_scale.gamma", r"decoder\.\d\.\w+_scale\.gamma"),
    ],
)
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_pattern_names_a_part_and_all_below_it(
    tiny: Tiny, pattern: str, expected: str, wrapped: bool
) -> None:
    recipe = tiny("locus", f'optimizer.parts={{"{pattern}": 0.5}}')
    model = recipe.build_model("meta")
    factors = recipe.rate_factors(nn.ModuleDict({"model": model}) if wrapped else model)
    found = {name.removeprefix("model.") for name, factor in factors.items() if factor == 0.5}
    wanted = {name for name, _ in model.named_parameters() if re.fullmatch(expected, name)}
    assert found == wanted != set()


def test_the_last_pattern_that_matches_counts(tiny: Tiny) -> None:
    parts = '{"*": 0.5, "head": 1, "head.linear.bias": 2}'
    recipe = tiny("locus", f"optimizer.parts={parts}")
    factors = recipe.rate_factors(recipe.build_model("meta"))
    names = ("queries.features", "head.linear.weight", "head.linear.bias")
    assert [factors[name] for name in names] == [0.5, 1, 2]


@pytest.mark.parametrize(
    ("pattern", "fix"),
    [
        ("encodr", "`encoder`"),
        ("decoder.9.self_attention", "`decoder.*.self_attention`"),
        ("decoder.1.self_atention", "`decoder.1.self_attention`"),
        ("decoder.refinment.x", "`decoder.refinement`"),
        ("*.*.*.*.*.*.*.*", "encoder, queries, decoder, refinements, head"),
    ],
)
def test_a_pattern_that_matches_nothing_ends_the_start(
    tiny: Tiny, tmp_path: Path, pattern: str, fix: str
) -> None:
    recipe = tiny("locus", f'optimizer.parts={{"{pattern}": 0.1}}')
    problem = refused(recipe, tmp_path / "run", by=run)
    assert (problem.file[:5], problem.option) == ("--set", f"optimizer.parts.{pattern}")
    assert fix in problem.fix
    assert not (tmp_path / "run").exists()


def test_a_factor_scales_the_step(tiny: Tiny, tmp_path: Path) -> None:
    """The first step of AdamW without decay is the learning rate, whatever the gradient."""
    options = ("training.steps=1", "optimizer.warmup=0", "optimizer.weight_decay=0.0")
    recipe = tiny("tokengs", *options, 'optimizer.parts={"head": 0.25, "queries": 2.0}')
    before = recipe.build_model().state_dict()
    after = weights(run(recipe, tmp_path))
    rate = recipe.build_optimizer().learning_rate(0, 0.0)
    for name, factor in {"head.linear.bias": 0.25, "queries.features": 2.0}.items():
        largest = float((after[name] - before[name]).abs().max())
        assert largest == pytest.approx(rate * factor, rel=1e-2)


def test_frozen_parts_stay_and_are_not_remembered(tiny: Tiny, tmp_path: Path) -> None:
    options = ("training.ema=0.5", "training.save_every=2", "optimizer.weight_decay=0.5")
    recipe = tiny("locus", *options, 'optimizer.parts={"encoder": 0, "decoder.*.feed_forward": 0}')
    before = recipe.build_model().state_dict()
    model = run(recipe, tmp_path).model
    for name, parameter in model.named_parameters():
        frozen = name.startswith("encoder.") or ".feed_forward." in name
        assert torch.equal(parameter, before[name]) == frozen, name
        assert (parameter.grad is None) == frozen, name
    moments = read_state(tmp_path / "state.safetensors").parts["moments"]
    assert moments
    assert not [key for key in moments if "model.encoder." in key or ".feed_forward." in key]


PLAIN = """
from torch.optim import SGD
from qgs.contracts import Optimizer, Plugin

class Plain(Optimizer):
    \"\"\"Gradient descent with momentum at one rate.\"\"\"
    name = "sgd"
    def build(self, groups):
        return SGD(groups, lr=self.config.learning_rate, momentum=0.9)

plugin = Plugin("plain", 1, (Plain,))
"""


def test_a_plugin_adds_an_optimiser_by_one_class(
    tiny: Tiny, tmp_path: Path, install: Callable[..., None]
) -> None:
    install("plain", "plain", PLAIN)
    tree = {**tiny("tokengs", "training.save_every=2").tree, "plugins": ["rooms", "plain"]}
    parts = {"encoder": 0, "head": 0.5}
    tree["optimizer"] = {"type": "plain/sgd", "learning_rate": 0.02, "parts": parts}
    recipe = resolve(tree)
    assert recipe.tree["optimizer"] == tree["optimizer"]
    through = run(recipe, tmp_path / "through")
    assert [record["lr"] for record in through.folder.history()] == [0.02] * 4
    run(resolve(tree, ["training.steps=2"]), tmp_path / "run")
    again = run(recipe, tmp_path / "run", resume=True)
    assert again.resumed_at == 2
    assert same(weights(again), weights(through))
    moments = read_state(again.folder.state).parts["moments"]
    assert {key.rsplit("/")[-1] for key in moments} == {"keys", "momentum_buffer"}


@pytest.mark.parametrize(
    "made",
    [
        "Adafactor(groups, lr=0.01)",
        pytest.param("SGD(groups, lr=0.01)", marks=pytest.mark.slow),
    ],
)
def test_moments_of_any_shape_and_none_are_restored(
    tiny: Tiny, tmp_path: Path, install: Callable[..., None], made: str
) -> None:
    code = PLAIN.replace("import SGD", "import SGD, Adafactor").replace('("plain"', '("other"')
    own = "SGD(groups, lr=self.config.learning_rate, momentum=0.9)"
    install("other", "other", code.replace(own, made))
    tree = {**tiny("tokengs").tree, "plugins": ["rooms", "other"]}
    tree["optimizer"] = {"type": "other/sgd"}
    through = run(resolve(tree), tmp_path / "through")
    run(resolve(tree, ["training.steps=2"]), tmp_path / "run")
    again = run(resolve(tree), tmp_path / "run", resume=True)
    assert again.resumed_at == 2
    assert same(weights(again), weights(through))


def test_parameters_that_no_gradient_reaches_do_not_hinder_going_on(
    tiny: Tiny, tmp_path: Path
) -> None:
    fixed = (
        "model.decoder.cross_attention.bandwidth=fixed",
        "model.centers.type=locus/anchor_offset",
    )
    run(tiny("locus", *fixed, "training.steps=3"), tmp_path / "run")
    moments = read_state(tmp_path / "run" / "state.safetensors").parts["moments"]
    assert not [key for key in moments if "raw_radius" in key]
    assert run(tiny("locus", *fixed), tmp_path / "run", resume=True).resumed_at == 3


class Small(nn.Module):
    """A weight, one that is shared, and a counter."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(3, 2, bias=False)
        self.second = self.first
        self.register_buffer("seen", torch.zeros((), dtype=torch.long))


def test_it_is_the_weighted_mean_of_all_weights_so_far() -> None:
    model = Small()
    average = MovingAverage(model, 0.9)
    history = [model.first.weight.detach().clone()]
    for step in range(5):
        with torch.no_grad():
            model.first.weight.copy_(torch.randn(2, 3))
            model.seen.add_(1)
        history.append(model.first.weight.detach().clone())
        average.update()
        assert int(average.state()["seen"]) == step + 1
    weights = [0.9**5, *(0.1 * 0.9 ** (4 - k) for k in range(5))]
    assert sum(weights) == pytest.approx(1)
    expected = sum(w * value for w, value in zip(weights, history, strict=True))
    assert set(average.state()) == {"first.weight", "seen"}, "shared weights once"
    torch.testing.assert_close(average.state()["first.weight"], expected)


def test_it_is_applied_for_a_while_only() -> None:
    model = Small()
    average = MovingAverage(model, 0.5)
    before = model.first.weight.detach().clone()
    with torch.no_grad():
        model.first.weight.add_(1.0)
    average.update()
    present = model.first.weight.detach().clone()
    with average.applied():
        torch.testing.assert_close(model.first.weight, before + 0.5)
    assert torch.equal(model.first.weight, present)


def test_the_average_of_half_precision_weights_is_float32() -> None:
    average = MovingAverage(Small().to(torch.bfloat16), 0.999)
    assert average.state()["first.weight"].dtype == torch.float32
