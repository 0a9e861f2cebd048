"""Every limit and epsilon of the releases is an option: published by default, and it matters."""

from functools import cache
from pathlib import Path

import torch
import yaml
from losses.judging import CAMERAS, GOLDEN, TRUTH, judged
from qgs_locus import plugin

from qgs import Views
from qgs.containers import named_tensors
from qgs.losses import COMPONENTS as LOSSES
from qgs.recipe import resolve
from qgs.recipe.recipe import flat

TABLE = yaml.safe_load((Path(__file__).parent / "limits.yaml").read_text())


@cache
def outcome(*overrides):
    """Options, and what the model makes of golden photos with weights of a seed."""
    recipe = resolve(TABLE["recipe"], overrides)
    model = recipe.build_model().eval()
    with torch.no_grad():
        gaussians = model(Views(TRUTH, CAMERAS)).gaussians
    return flat(recipe.tree), torch.cat([part.flatten() for _, part in named_tensors(gaussians)])


def test_limits_are_published_by_default_and_matter():
    for row in TABLE["components"]:
        beside = row.get("beside", [])
        options, made = outcome(*beside)
        for option, (published, other) in row["limits"].items():
            paths = [f"{place}.{option}" for place in row["at"]]
            assert [options[path] for path in paths] == [published] * len(paths), paths
            changed = [f"{path}={other!r}" for path in paths]
            assert not torch.equal(outcome(*beside, *changed)[1], made), changed


def test_limits_of_losses_are_published_by_default_and_matter():
    first = slice(1)
    depths = torch.full_like(TRUTH[:, first, :1], 1.5)
    views = Views(TRUTH[:, first], CAMERAS[:, first], depths=depths)
    means = GOLDEN["points"]
    opacities = GOLDEN["opacity"][..., 0]
    losses = {loss.name: loss for loss in (*LOSSES, *plugin.components)}
    for row in TABLE["losses"]:
        options = dict(row)
        loss = losses[options.pop("loss")]
        beside = options.pop("beside", {})
        for option, (published, other) in options.items():
            configs = [loss.Config(**beside), loss.Config(**{**beside, option: other})]
            terms = [judged(loss(config), views, means, opacities)[loss.name] for config in configs]
            assert getattr(configs[0], option) == published, (loss.name, option)
            assert terms[0] != terms[1], (loss.name, option)


def test_the_recipes_have_the_limits_of_their_releases():
    for recipe, limits in TABLE["recipes"].items():
        options = flat(resolve(recipe).tree)
        assert {path: options[path] for path in limits} == limits, recipe
