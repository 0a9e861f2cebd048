"""Options that follow the progress of training: their numbers, in recipes, and what is refused."""

import json
import math
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml

import qgs
from qgs.components import MlpFeedForward
from qgs.components.schedules import SCHEDULES
from qgs.composer import Recipe, RecipeError, resolve
from qgs.composer.recipe import annotated
from qgs.contracts import ComponentConfig
from qgs.contracts.schedule import at_step, follow, number_kinds

RECIPES = Path(__file__).parents[2] / "recipes"
DILATION = "model.renderer.dilation"
RAMP = "{schedule: linear, values: [10, 0.5], at: [100, 200]}"
FALL = "{schedule: steps, values: [10, 3, 0.3], at: [10, 20]}"


def tiny(*overrides: str) -> Recipe:
    return resolve(RECIPES / "tiny" / "tokengs.yaml", overrides)


@pytest.mark.parametrize(
    ("options", "numbers"),
    [
        ({"schedule": "constant", "value": 2}, {0: 2, 10**9: 2}),
        (
            {"schedule": "linear", "values": [10, 0], "at": [100, 200]},
            {0: 10, 100: 10, 101: 9.9, 150: 5, 199: 0.1, 200: 0, 10**9: 0},
        ),
        (
            {"schedule": "cosine", "values": [1, 3], "at": [0, 4]},
            {0: 1, 1: 2 - math.sqrt(0.5), 2: 2, 3: 2 + math.sqrt(0.5), 4: 3, 5: 3},
        ),
        (
            {"schedule": "linear", "values": [0, 1, 1, 3], "at": [10, 20, 40, 60]},
            {0: 0, 10: 0, 15: 0.5, 20: 1, 30: 1, 40: 1, 50: 2, 60: 3, 61: 3},
        ),
        (
            {"schedule": "steps", "values": [10, 3, 1], "at": [5, 7]},
            {0: 10, 4: 10, 5: 3, 6: 3, 7: 1, 10**9: 1},
        ),
    ],
)
def test_numbers(options: dict[str, Any], numbers: dict[int, float]) -> None:
    schedule = SCHEDULES[options["schedule"]].model_validate_json(json.dumps(options))
    assert {step: schedule.number(step) for step in numbers} == pytest.approx(numbers)


def test_a_resolved_recipe_shows_it_and_resolves_to_the_same() -> None:
    recipe = tiny(f"{DILATION}={RAMP}", f"losses.photometric.ssim_weight={FALL}")
    text = annotated(recipe)
    assert [line.split("#")[0].strip() for line in text.splitlines() if "--set" in line] == [
        *("schedule: linear", "values: [10.0, 0.5]", "at: [100, 200]"),
        *("schedule: steps", "values: [10.0, 3.0, 0.3]", "at: [10, 20]"),
    ]
    again = resolve(yaml.safe_load(text))
    assert again.tree == recipe.tree
    assert again.schedules == recipe.schedules
    assert recipe.schedules.keys() == {("model", "renderer"), ("losses", "photometric")}
    assert recipe.build_model("meta").renderer.config.dilation == 10, "of the first step"


def test_another_schedule_replaces_the_one_below_whole() -> None:
    recipe = tiny(f"{DILATION}={RAMP}", f"{DILATION}={FALL}")
    assert recipe.tree["model"]["renderer"]["dilation"]["at"] == [10, 20]
    recipe = tiny(f"{DILATION}={RAMP}", f"{DILATION}.values=[10, 1]")
    assert recipe.tree["model"]["renderer"]["dilation"]["at"] == [100, 200]
    assert tiny(f"{DILATION}={RAMP}", f"{DILATION}=1").schedules == {}


@pytest.mark.parametrize(
    ("override", "seen"),
    [
        (
            "model.queries.count={schedule: constant, value: 3}",
            "`count` of `qgs/latent` takes no schedule",
        ),
        ("optimizer.warmup={schedule: constant, value: 3}", "(options that can: learning_rate)"),
        ("losses.visibility.clamp={schedule: constant, value: 3}", "(options that can: weight)"),
        (f"{DILATION}={{schedule: linaer, values: [1, 2], at: [1, 2]}}", "mean `linear`?"),
        (
            f"{DILATION}={{values: [1, 2], at: [1, 2]}}",
            "schedules: constant, cosine, linear, steps",
        ),
        (f"{DILATION}={{schedule: linear, at: [1, 2]}}", "`values` is missing"),
        (f"{DILATION}={{schedule: linear, value: [1, 2], at: [1, 2]}}", "did you mean `values`?"),
        (f"{DILATION}={{schedule: linear, values: [1], at: [1]}}", "at least 2"),
        (
            f"{DILATION}={{schedule: cosine, values: [1, 2], at: [1]}}",
            "need 2 steps in `at`, got 1",
        ),
        (f"{DILATION}={{schedule: linear, values: [1, 2], at: [2, 2]}}", "write [2]"),
        (f"{DILATION}={{schedule: steps, values: [1, 2], at: [0]}}", "at least 1"),
        (f"{DILATION}={{schedule: steps, values: [1, 2], at: [3, 2]}}", "write [2, 3]"),
        (f"{DILATION}={{schedule: steps, values: [1, 2], at: [2, 3]}}", "part 3 values, got 2"),
        (f"{DILATION}={{schedule: linear, values: [1, -2], at: [1, 2]}}", "got the number -2"),
        (f"{DILATION}={{schedule: steps, values: [1, -2, 1], at: [2, 3]}}", "got the number -2"),
        ("model.renderer.near={schedule: linear, values: [1, 200], at: [0, 9]}", "near 200 and"),
        ("training.clip={schedule: constant, value: 3}", "must be a valid number, got a mapping"),
    ],
)
def test_what_cannot_be_is_refused(override: str, seen: str) -> None:
    with pytest.raises(RecipeError) as error:
        tiny(override)
    assert seen in str(error.value)
    assert "--set #1" in str(error.value)


def test_limits_hold_up_to_the_last_step_before_a_jump() -> None:
    near = "model.renderer.near={schedule: linear, values: [0.025, 10], at: [0, 100]}"
    far = "model.renderer.far={{schedule: steps, values: [{}, 100], at: [100]}}"
    with pytest.raises(RecipeError, match=r"near 9\.9\d* and far 5"):
        tiny(near, far.format(5))
    assert tiny(near, far.format(9.95)).schedules


def test_a_schedule_that_training_does_not_finish_is_told() -> None:
    recipe = tiny(f"{DILATION}={RAMP}", "training.steps=150")
    assert recipe.warnings == [f"{DILATION} changes until step 200, training ends at 150"]
    length = ("training.steps=200", "training.seconds=null")
    assert tiny(f"{DILATION}={RAMP}", *length).warnings == []


def test_a_schedule_counts_steps_whatever_the_time_budget() -> None:
    (told,) = tiny(f"{DILATION}={RAMP}", "training.steps=200", "training.seconds=90").warnings
    assert told.startswith(f"{DILATION} changes until step 200, and training.seconds may end")
    assert "after 90 s" in told
    still = f"{DILATION}={{schedule: constant, value: 1}}"
    assert tiny(still, "training.seconds=90").warnings == []


class Blend(MlpFeedForward):
    """A component of the model whose options, one of them whole, may follow the training."""

    name: ClassVar[str] = "blend"
    scheduled = frozenset({"share", "level"})

    class Config(MlpFeedForward.Config):
        share: float | None = None
        level: int = 1


PLUGIN = qgs.Plugin("mine", qgs.CONTRACT_VERSION, (Blend,))


def test_components_of_layers_follow_too_and_whole_numbers_are_rounded() -> None:
    level = "{schedule: linear, values: [1, 4], at: [0, 10]}"
    share = "{schedule: cosine, values: [0, 1], at: [0, 10]}"
    options = f"model.decoder.feed_forward={{type: mine/blend, level: {level}, share: {share}}}"
    own = "model.decoder.layers.1.feed_forward={level: {schedule: constant, value: 7}}"
    recipe = resolve(
        RECIPES / "tiny" / "tokengs.yaml", ["plugins=[rooms, mine]", options, own], [PLUGIN]
    )
    model = recipe.build_model("meta")
    assert resolve(recipe.tree, plugins=[PLUGIN]).schedules == recipe.schedules
    for step, wanted in ((0, 1), (3, 2), (5, 2), (9, 4), (99, 4)):
        follow(model.modules(), step)
        configs = [layer.feed_forward.config for layer in model.decoder]
        assert [config.level for config in configs] == [wanted, 7, wanted, wanted]
        assert type(configs[0].level) is int
        assert 0 <= configs[0].share <= 1
    half = options.replace("[1, 4]", "[1, 4.5]")
    with pytest.raises(RecipeError, match="must be a valid integer"):
        resolve(RECIPES / "tiny" / "tokengs.yaml", ["plugins=[rooms, mine]", half], [PLUGIN])


def test_kinds_of_numbers() -> None:
    assert number_kinds(float | None) == {float}
    assert number_kinds(int) == {int}
    assert not number_kinds(bool)
    assert not number_kinds(tuple[float, ...])
    config = ComponentConfig()
    assert at_step(config, {}, 3) == config
