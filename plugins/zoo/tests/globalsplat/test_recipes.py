"""Recipes, losses and views of both passes: sizes, what is refused, a small training.

tests/train/test_training_pass.py tests what two passes judge.
"""

from functools import partial

import torch
import torch.nn.functional as F
import yaml
from odd_views import odd_views
from qgs_dev import Case
from qgs_dev.inputs import Sizes, inputs_of
from qgs_zoo.globalsplat.losses import Frustum, Regularisers, beyond_frusta, subset
from torch.testing import assert_close
from training_runs import run

import qgs
from qgs.model_text import parameter_counts
from qgs.recipe import resolve

PUBLISHED = "globalsplat/re10k.yaml"
TINY = "tiny/globalsplat.yaml"
SMALL = """
model.width=32 model.heads=2 model.decoder.depth=1 model.supervision.layers=[1]
model.queries.count=40 model.encoder.patch_size=4 data.image_size=[16,16] views.inputs=4
training.steps=6 training.seconds=null optimizer.warmup=2 evaluation.scenes=2
"""


def test_parameters_of_the_published_size():
    """By arithmetic: 512 wide, 8 heads, 2057 tokens, four rounds of two blocks, 16 candidates."""
    model = qgs.compose(PUBLISHED, device="meta")
    counts = [*filter(None, parameter_counts(model).values())]
    assert counts == [227_712, 1_580_544, 4 * 20_502_528, 510_944]  # 84,329,312
    assert len(model.queries.slots) == 2048
    assert len(model.queries.extra) == 9


LEVELS = """
{0: 0, 9999: 0, 10000: 0, 10500: 0.25, 12000: 1, 15000: 1, 21500: 1.75, 22000: 2, 51000: 2.5,
 52000: 3, 219999: 3}
"""


def test_published_training():
    recipe = resolve(PUBLISHED)
    (schedules,) = [part.schedules for part in recipe.parts.values() if part.schedules]
    levels = yaml.safe_load(LEVELS)
    assert {step: schedules["level"].number(step) for step in levels} == levels
    optimizer = recipe.tree["optimizer"]
    assert optimizer["initial_divisor"] * optimizer["final_divisor"] == 50
    assert optimizer["warmup"] == 0.03 * recipe.training.steps


def test_two_passes_train_a_head_that_grows(here):
    growing = "model.head.level={schedule: steps, values: [0, 0.5, 1, 3], at: [1, 2, 4]}"
    two = "objective={type: globalsplat/two_passes}"
    folder = run(resolve(TINY, [*SMALL.split(), two, growing])).folder
    assert [record["frustum"] > 0 for record in folder.history()] == [True] * 6
    assert qgs.load(folder.checkpoint).head.gaussians_per_query == 8  # those of the last step
    assert qgs.compose(TINY, overrides=[growing]).head.gaussians_per_query == 1  # of the first one


SOFT = 0.1
NEAR = 0.2
VIEWS = odd_views(2, 16, 24)


def beyond_one(points, c2w, lens):
    """Softplus of the distances beyond five planes, each through the centre and two corners."""
    local = (points - c2w[:3, 3]) @ c2w[:3, :3]
    pixels = torch.tensor([[0, 0], [24, 0], [24, 16], [0, 16]])
    corners = F.pad((pixels - lens[2:]) / lens[:2], (0, 1), value=1.0)
    planes = F.normalize(torch.linalg.cross(corners, corners.roll(-1, 0)), dim=1)
    beyond = local @ (planes * planes[:, 2:].sign()).T
    return F.softplus(torch.cat([NEAR - local[:, 2:], -beyond], 1) / SOFT).sum(1)


def test_the_frustum_of_each_view():
    """Of points in front, at the sides, behind."""
    seen = odd_views(3, 16, 24).cameras
    points = torch.randn(2, 9, 3) * torch.tensor([0.6, 0.6, 2.0])
    found = beyond_frusta(points, seen, SOFT, NEAR)
    for scene, cameras in enumerate(zip(seen.c2w, seen.intrinsics, strict=True)):
        each = torch.stack([*map(partial(beyond_one, points[scene]), *cameras)])
        assert_close(found[scene], -SOFT * (-each).exp().mean(0).log())


GIVEN, NOTHING, _, _ = inputs_of(Case(Frustum.Config()), Sizes(queries=3, gaussians=2)).values()
"""A prediction of three queries, two Gaussians each; no rendering."""


def test_losses_are_means_over_gaussians_of_tokens_that_decode_some():
    mask = torch.tensor([[True, True, False], [True, False, False]])
    rest = (GIVEN.replace(state=GIVEN.state.replace(mask=mask)), NOTHING, VIEWS, VIEWS)

    def mean(x):
        return (x[0, :4].mean() + x[1, :2].mean()) / 2

    terms = Regularisers(Regularisers.Config(opacity_weight=0.5, scale_weight=2.0))(*rest)
    assert_close(terms["mean_opacity"], 0.5 * mean(GIVEN.gaussians.opacities))
    assert_close(terms["mean_scale"], 2.0 * mean(GIVEN.gaussians.scales))
    terms = Frustum(Frustum.Config(weight=3.0))(*rest)
    per_point = beyond_frusta(GIVEN.gaussians.means, VIEWS.cameras, 0.05, 0.05)
    assert_close(terms["frustum"], 3.0 * mean(per_point))


def test_passes_share_the_ends_and_part_the_rest():
    for count in range(3, 13):
        one = subset(count, 0)
        other = subset(count, 1)
        assert {*one} & {*other} == {0, count - 1}
        assert {*one} | {*other} == {*range(count)}
        assert [sorted(one), sorted(other)] == [[*one], [*other]]
        assert 0 <= len(one) - len(other) <= 1
