"""Scenes that move: the embedding of times, which queries carry them, who reads whom."""

import pytest
import torch
from odd_views import odd_views
from qgs_zoo.tokengs2026.dynamic import MOVES, DynamicQueries
from qgs_zoo.tokengs2026.multiscale import MultiscaleViT, TimeEmbedding
from small_parts import made
from tables import must_refuse
from torch.testing import assert_close

from qgs.recipe import resolve
from qgs.train.training_pass import TrainingPass
from qgs.types import ImageMemory, LayerPrediction, Photos

PUBLISHED = "tokengs/dynamic.yaml"

MEMORY = ImageMemory(torch.zeros(2, 3, 16))


VIT = "type: tokengs2026/multiscale_vit, depth: 1, blocks: [1], time_channels: 4"
SIZES = (
    "width=16 heads=2 queries.count=7 queries.dynamic=3 queries.std=1 decoder.depth=2 "
    "decoder.layer_scale=0.5 head.gaussians_per_query=2 head.init_std=0.5 supervision.layers=[2]"
)
SMALL = (
    "plugins=[tokengs2026, rooms]",
    "evaluation.tuning=queries",
    f"model.encoder={{{VIT}, layer_scale: 0.5}}",
    *(f"model.{size}" for size in SIZES.split()),
)


def small(*overrides):
    return resolve(PUBLISHED, [*SMALL, *overrides])


def views(times=None, target=None):
    return odd_views().replace(times=times, target_time=target)


INPUTS = views(torch.zeros(2, 2), torch.zeros(2, 1))
TARGETS = INPUTS.select([0]).replace(target_time=None)


def test_times_are_embedded_as_zeros_at_first():
    assert not TimeEmbedding(4, 16, 8)(torch.rand(1, 2)).any()


def test_the_target_time_is_added_to_the_dynamic_queries_or_to_all():
    """They do without cameras."""
    assert not DynamicQueries.reads_cameras
    photos = [Photos(INPUTS.images, target_time=torch.tensor([[x], [0.5]])) for x in (0.0, 1.0)]
    for dynamic, moving in ((3, [False] * 4 + [True] * 3), (0, [True] * 7)):
        queries = made(DynamicQueries, count=7, dynamic=dynamic)
        torch.nn.init.normal_(queries.time_embedding.proj.weight)
        early, late = (queries(MEMORY, each) for each in photos)
        assert (early.features != late.features).any(-1).tolist() == [moving, [False] * 7]
        fields = {name: x.tolist() for name, x in early.fields.items()}
        assert fields == ({MOVES: [moving] * 2} if dynamic else {})


@pytest.fixture
def model():
    model = small().build_model().eval()
    for embedding in (model.encoder, model.queries):
        torch.nn.init.normal_(embedding.get_submodule("time_embedding").proj.weight)
    return model


def test_views_without_times_are_refused(model):
    must_refuse(
        r"reads the times of photos, .*time_channels to 0", model, views(target=torch.zeros(2, 1))
    )
    must_refuse(r"requested time: .* target_time \(B, 1\)", model, views(torch.zeros(2, 2)))


def test_the_objective_judges_dynamic_gaussians_again(model):
    gaussians = model(INPUTS).gaussians[:, 4 * 2 :]
    rendering = model.render(gaussians, TARGETS.cameras)
    layer = LayerPrediction(gaussians, model.queries(MEMORY, INPUTS))
    for weight in (0.5, 0.0):
        objective = TrainingPass(small(f"objective.weight={weight}"), model)
        terms = objective(INPUTS, TARGETS).terms
        losses = [loss(layer, rendering, TARGETS, INPUTS) for loss in objective.losses.values()]
        expected = weight * sum(value for own in losses for value in own.values())
        assert_close(terms["dynamic"], expected)


def test_no_loss_may_have_the_term_of_the_objective(model):
    objective = TrainingPass(small(), model)
    loss = next(iter(objective.losses.values()))
    loss.forward = lambda *given: {"dynamic": given[0].gaussians.means.sum()}
    must_refuse(r"losses have terms \['dynamic'\] already", objective, INPUTS, TARGETS)


def test_larger_patches_embed_times_as_smaller_ones():
    options = {"depth": 1, "blocks": (1,), "time_channels": 2}
    small, large = (made(MultiscaleViT, patch_size=side, **options) for side in (4, 8))
    torch.nn.init.normal_(small.time_embedding.proj.weight)
    large.load_state_dict(large.adapted(small.state_dict()))
    times = torch.rand(2, 3)
    assert_close(large.time_embedding(times), small.time_embedding(times))


def test_the_published_weight_of_dynamic_gaussians():
    schedule = resolve(PUBLISHED).build_objective().schedules["weight"]
    weights = map(schedule.number, (0, 5000, 10_000, 15_000, 20_000))
    assert [*weights] == pytest.approx([0.3, 0.3, 0.15, 0, 0])
