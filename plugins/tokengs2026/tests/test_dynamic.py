"""Scenes that move: the embedding of times, which queries carry them, who reads whom."""

import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from qgs_tokengs2026.dynamic import MOVES, BlockCausalSelfAttention, DynamicQueries
from qgs_tokengs2026.multiscale import MultiscaleViT
from qgs_tokengs2026.times import TimeEmbedding, time_features
from torch import Tensor

from qgs import Cameras, Views
from qgs.components import LatentQueries
from qgs.composer import RecipeError, resolve
from qgs.contracts import ModelDims
from qgs.contracts.schedule import follow
from qgs.engine.training_pass import TrainingPass
from qgs.model import QueryGaussianModel
from qgs.types import ImageMemory, LayerPrediction, Photos

TOKENGS = Path(__file__).parents[3] / "recipes/tokengs"

DIMS = ModelDims(width=16, heads=2, depth=1)
MEMORY = ImageMemory(torch.zeros(2, 3, 16))
RECIPE: dict[str, Any] = {
    "recipe": 1,
    "plugins": ["tokengs2026"],
    "model": {
        "width": 16,
        "heads": 2,
        "encoder": {
            "type": "tokengs2026/multiscale_vit",
            "depth": 1,
            "blocks": [1],
            "time_channels": 4,
            "layer_scale": 0.5,
        },
        "queries": {"type": "tokengs2026/dynamic", "count": 7, "dynamic": 3, "std": 1.0},
        "decoder": {
            "depth": 2,
            "layer_scale": 0.5,
            "self_attention": {"type": "tokengs2026/block_causal"},
        },
        "head": {"gaussians_per_query": 2, "init_std": 0.5},
        "supervision": {"layers": [2]},
    },
}


def views(times: Tensor | None = None, target: Tensor | None = None, batch: int = 2) -> Views:
    generator = torch.Generator().manual_seed(0)
    c2w = torch.eye(4).repeat(batch, 2, 1, 1)
    cameras = Cameras(c2w, torch.tensor([16.0, 16, 8, 8]).expand(batch, 2, 4), (16, 16))
    images = torch.rand(batch, 2, 3, 16, 16, generator=generator)
    return Views(images, cameras, times=times, target_time=target)


def test_times_as_cosines_and_sines() -> None:
    times = torch.tensor([[0.0, 2.5]])
    rates = [1.0, 1e4**-0.5]
    expected = [[math.cos(2.5 * r) for r in rates] + [math.sin(2.5 * r) for r in rates]]
    found = time_features(times, 4)
    torch.testing.assert_close(found[0, 1:], torch.tensor(expected))
    torch.testing.assert_close(found[0, 0], torch.tensor([1.0, 1, 0, 0]))


def test_the_embedding_is_that_of_a_map_of_constant_times() -> None:
    embedding = TimeEmbedding(2, 16, 8)
    assert not embedding(torch.rand(2, 3)).any()
    for parameter in embedding.parameters():
        torch.nn.init.normal_(parameter)
    times = torch.tensor([[0.3], [0.8]])
    constant = time_features(times[:, 0], 2)[..., None, None].expand(-1, -1, 16, 24)
    patches = embedding.proj(constant).flatten(2).mT
    torch.testing.assert_close(embedding(times).expand(-1, 6, -1), patches)


@pytest.mark.parametrize(("dynamic", "moving"), [(3, [0] * 4 + [1] * 3), (0, [1] * 7)])
def test_the_target_time_is_added_to_the_dynamic_queries_or_to_all(
    dynamic: int, moving: list[int]
) -> None:
    queries = DynamicQueries(DynamicQueries.Config(count=7, dynamic=dynamic), DIMS)
    torch.nn.init.normal_(queries.time_embedding.proj.weight)
    early, late = (
        queries(MEMORY, views(target=torch.tensor([[time], [0.5]]))) for time in (0.0, 1.0)
    )
    changed = (early.features != late.features).any(-1)
    assert changed[0].int().tolist() == moving
    assert not changed[1].any()
    if dynamic:
        assert torch.equal(early[MOVES], torch.tensor([moving] * 2).bool())
    assert early.fields.keys() == DynamicQueries.fields_written(queries.config).keys()


@pytest.mark.parametrize("dynamic", [3, 0])
def test_that_nothing_reads_which_queries_move_is_no_warning(dynamic: int) -> None:
    queries = {**RECIPE["model"]["queries"], "dynamic": dynamic}
    still = {**RECIPE["model"], "queries": queries, "decoder": {"depth": 2}}
    assert resolve({**RECIPE, "model": still}).warnings == []
    with nullcontext() if dynamic else pytest.raises(RecipeError, match="which nothing"):
        resolve({**RECIPE, "model": {**RECIPE["model"], "queries": queries}})


def test_what_reads_dynamic_queries_is_refused_without_them() -> None:
    with pytest.raises(RecipeError) as caught:
        resolve(TOKENGS / "dynamic.yaml", ["model.queries.dynamic=0"])
    assert len(caught.value.problems) == 2
    assert all(MOVES in problem.reason for problem in caught.value.problems)


def test_static_queries_do_not_see_dynamic_ones() -> None:
    queries = DynamicQueries(DynamicQueries.Config(count=7, dynamic=3, time_channels=0), DIMS)
    state = queries(MEMORY, views())
    attention = BlockCausalSelfAttention(BlockCausalSelfAttention.Config(), DIMS)
    told = attention.explain(state, torch.arange(7))
    seen = told.weights[0, 0] > 0
    block, index = torch.tensor([0] * 4 + [1] * 3), torch.arange(7)
    allowed = (block[:, None] == block) | (index[:, None] >= index)
    assert torch.equal(seen, allowed)
    other = state.replace(features=state.features + state[MOVES][..., None])
    assert torch.equal(attention(state)[:, :4], attention(other)[:, :4])
    values = attention.attention.project(attention.norm(state.features))[2]
    expected = (told.weights @ values).transpose(1, 2).flatten(2)
    torch.testing.assert_close(attention(state), attention.attention.proj(expected))


def model() -> QueryGaussianModel:
    model = resolve(RECIPE).build_model().eval()
    for embedding in (model.encoder, model.queries):
        torch.nn.init.normal_(embedding.get_submodule("time_embedding").proj.weight)
    return model


def test_a_prediction_depends_on_the_times_of_photos_and_on_the_time_asked_for() -> None:
    reconstruct, times = model(), torch.tensor([[0.1, 0.9]] * 2)
    first = reconstruct(views(times, torch.tensor([[0.2]] * 2))).gaussians.means
    later = reconstruct(views(times, torch.tensor([[0.7]] * 2))).gaussians.means
    others = reconstruct(views(times + 0.1, torch.tensor([[0.2]] * 2))).gaussians.means
    assert torch.equal(first[:, :8], later[:, :8])
    assert not torch.equal(first[:, 8:], later[:, 8:])
    assert not torch.equal(first[:, :8], others[:, :8])


def test_views_without_times_are_refused() -> None:
    reconstruct, times = model(), torch.zeros(2, 2)
    with pytest.raises(ValueError, match=r"reads the times of photos .*time_channels to 0"):
        reconstruct(views(target=torch.zeros(2, 1)))
    with pytest.raises(ValueError, match=r"requested time: .* target_time \(B, 1\)"):
        reconstruct(views(times))


def test_dynamic_queries_do_without_cameras() -> None:
    queries = DynamicQueries(DynamicQueries.Config(count=7, dynamic=3), DIMS)
    torch.nn.init.normal_(queries.time_embedding.proj.weight)
    given = views(target=torch.tensor([[0.1], [0.5]]))
    photos: Any = Photos(given.images, target_time=given.target_time)
    assert not DynamicQueries.reads_cameras
    assert torch.equal(queries(MEMORY, photos).features, queries(MEMORY, given).features)


def test_what_reads_times_is_refused_beside_data_that_tell_none() -> None:
    assert resolve(RECIPE)
    assert resolve({**RECIPE, "data": {"type": "qgs/photos", "path": "x"}})
    with pytest.raises(RecipeError) as caught:
        resolve(
            {**RECIPE, "plugins": ["rooms", "tokengs2026"], "data": {"type": "rooms/procedural"}}
        )
    told = {problem.option: problem.reason for problem in caught.value.problems}
    reason = "the data of this recipe have no times: `time_channels: {}` reads them"
    assert told == {
        "model.encoder.time_channels": reason.format(4),
        "model.queries.time_channels": reason.format(2),
    }


def test_views_keep_the_time_that_is_asked_for() -> None:
    both = views(torch.tensor([[0.1, 0.9]] * 2), torch.zeros(2, 1))
    chosen = both.select([1])
    assert chosen.times is not None
    assert chosen.times.tolist() == torch.tensor([[0.9], [0.9]]).tolist()
    assert chosen.target_time is both.target_time
    with pytest.raises(ValueError, match=r"Views.times must have shape \(2, 2\), got \(2, 3\)"):
        views(torch.zeros(2, 3))


def test_what_time_adds_to_the_parameters() -> None:
    count = sum(p.numel() for p in DynamicQueries(DynamicQueries.Config(), DIMS).parameters())
    still = sum(
        p.numel() for p in LatentQueries(LatentQueries.Config(count=1280), DIMS).parameters()
    )
    assert count == still + 16 * 2 * 8 * 8 + 16
    timed = MultiscaleViT(MultiscaleViT.Config(depth=1, blocks=(1,), time_channels=2), DIMS)
    untimed = MultiscaleViT(MultiscaleViT.Config(depth=1, blocks=(1,)), DIMS)
    assert timed.state_dict().keys() - untimed.state_dict().keys() == {
        "time_embedding.proj.weight",
        "time_embedding.proj.bias",
    }


@pytest.mark.parametrize("weight", [0.3, 0.0])
def test_the_objective_judges_dynamic_gaussians_again(weight: float) -> None:
    recipe = resolve({**RECIPE, "objective": {"type": "tokengs2026/dynamic", "weight": weight}})
    reconstruct = model()
    inputs = views(torch.zeros(2, 2), torch.zeros(2, 1))
    targets = replace(inputs.select([0]), target_time=None)
    outcome = TrainingPass.of(recipe, reconstruct)(inputs, targets)
    gaussians = reconstruct(inputs).gaussians[:, 4 * 2 :]
    rendering = reconstruct.render(gaussians, targets.cameras)
    layer = LayerPrediction(gaussians, reconstruct.queries(MEMORY, inputs))
    terms = [loss(layer, rendering, targets, inputs) for loss in recipe.build_losses().values()]
    expected = weight * sum(sum(found.values()) for found in terms)
    torch.testing.assert_close(outcome.terms["dynamic"], torch.as_tensor(expected))
    torch.testing.assert_close(outcome.total.detach(), sum(outcome.terms.values()))


def test_no_loss_may_have_the_term_of_the_objective() -> None:
    recipe = resolve({**RECIPE, "objective": {"type": "tokengs2026/dynamic"}})
    judging = TrainingPass.of(recipe, model())
    loss = next(iter(judging.losses.values()))
    loss.forward = lambda *given: {"dynamic": given[0].gaussians.means.sum()}
    inputs = views(torch.zeros(2, 2), torch.zeros(2, 1))
    with pytest.raises(ValueError, match=r"losses have terms \['dynamic'\] already"):
        judging(inputs, replace(inputs.select([0]), target_time=None))


def test_larger_patches_embed_times_as_smaller_ones() -> None:
    small, large = (
        MultiscaleViT(
            MultiscaleViT.Config(depth=1, blocks=(1,), patch_size=side, time_channels=2), DIMS
        )
        for side in (4, 8)
    )
    torch.nn.init.normal_(small.time_embedding.proj.weight)
    large.load_state_dict(large.adapted(small.state_dict()))
    times = torch.rand(2, 3)
    torch.testing.assert_close(large.time_embedding(times), small.time_embedding(times))


def test_the_published_weight_of_dynamic_gaussians() -> None:
    objective = resolve(TOKENGS / "dynamic.yaml").build_objective()
    weights = []
    for step in (0, 5000, 10_000, 15_000, 20_000):
        follow([objective], step)
        weights.append(objective.config.weight)
    assert weights == pytest.approx([0.3, 0.3, 0.15, 0, 0])


def test_static_queries_have_nothing_for_the_objective() -> None:
    tree = {"recipe": 1, "plugins": ["tokengs2026"], "objective": {"type": "tokengs2026/dynamic"}}
    with pytest.raises(RecipeError, match=r"`tokengs2026/dynamic` needs dynamic.moves"):
        resolve(tree)
