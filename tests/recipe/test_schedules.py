"""Options that follow the progress of training: their numbers, and models that follow them."""

import json
from typing import ClassVar

import pytest
import yaml

import qgs
from qgs.contracts.schedule import follow
from qgs.recipe import resolve
from qgs.tokengs import MlpFeedForward
from qgs.tokengs.schedules import SCHEDULES

NUMBERS = """
- [{schedule: constant, value: 2}, {0: 2, 1000000000: 2}]
- - {schedule: linear, values: [10, 0], at: [100, 200]}
  - {0: 10, 100: 10, 101: 9.9, 150: 5, 199: 0.1, 200: 0, 1000000000: 0}
- - {schedule: cosine, values: [1, 3], at: [0, 4]}
  - {0: 1, 1: 1.292893219, 2: 2, 3: 2.707106781, 4: 3, 5: 3}
- - {schedule: linear, values: [0, 1, 1, 3], at: [10, 20, 40, 60]}
  - {0: 0, 10: 0, 15: 0.5, 20: 1, 30: 1, 40: 1, 50: 2, 60: 3, 61: 3}
- - {schedule: steps, values: [10, 3, 1], at: [5, 7]}
  - {0: 10, 4: 10, 5: 3, 6: 3, 7: 1, 1000000000: 1}
"""
"""Options of a schedule; step to number."""


def test_numbers():
    for options, numbers in yaml.safe_load(NUMBERS):
        schedule = SCHEDULES[options["schedule"]].model_validate_json(json.dumps(options))
        assert {step: schedule.number(step) for step in numbers} == pytest.approx(numbers), options


class Blend(MlpFeedForward):
    """A component of the model whose options, one of them whole, may follow the training."""

    name: ClassVar[str] = "blend"
    scheduled = frozenset({"share", "level"})

    class Config(MlpFeedForward.Config):
        share: float | None = None
        level: int = 1


def test_components_of_layers_follow_too_and_whole_numbers_are_rounded():
    level = "{schedule: linear, values: [1, 4], at: [0, 10]}"
    share = "{schedule: cosine, values: [0, 1], at: [0, 10]}"
    options = f"model.decoder.feed_forward={{type: mine/blend, level: {level}, share: {share}}}"
    own = "model.decoder.layers.1.feed_forward={level: {schedule: constant, value: 7}}"
    plugins = [qgs.Plugin("mine", qgs.CONTRACT_VERSION, (Blend,))]
    recipe = resolve("tiny/tokengs.yaml", ["plugins=[mine]", options, own], plugins)
    model = recipe.build_model("meta")
    assert resolve(recipe.tree, plugins=plugins).tree == recipe.tree
    for step, wanted in ((0, 1), (3, 2), (9, 4), (99, 4)):
        follow(model.modules(), step)
        configs = [layer.feed_forward.config for layer in model.decoder]
        assert [config.level for config in configs] == [wanted, 7, wanted, wanted]
        assert type(configs[0].level) is int
    assert configs[0].share == 1
