"""Every formula against what is written out by hand: starts, Gaussians, neighbours, errors."""

import math

import pytest
import torch
import torch.nn.functional as F
from qgs_landmark.fields import COLORS, FRAME
from qgs_landmark.footprint import ColoredHead, FootprintCenters
from qgs_landmark.neighbours import NeighbourAttention, nearest
from qgs_landmark.observed import ObservedQueries
from qgs_landmark.refinement import FramedRefinement
from qgs_landmark.rendered import RenderedFeedback
from qgs_locus.fields import CENTER, RAW_RADIUS, support_radius
from qgs_locus.refinement import AnchorRefinement
from torch import Tensor

from qgs.components.blocks import split_heads
from qgs.composer import resolve
from qgs.contracts import ModelDims
from qgs.engine.initial import initialise
from qgs.geometry.rays import camera_rays
from qgs.types import Cameras, ImageMemory, QueryState, Rendering, Views

DIMS = ModelDims(width=16, heads=2, depth=2)
GRID, SIZE, PATCH = (2, 4, 6), (16, 24), 4
TOKENS = math.prod(GRID)


def views() -> Views:
    """Two scenes of two photos, the cameras turned and moved."""
    turn = torch.tensor([[0.0, 0.3], [-0.2, 0.1]], dtype=torch.float64)
    c2w = torch.eye(4, dtype=torch.float64).repeat(2, 2, 1, 1)
    c2w[..., 0, 0] = c2w[..., 2, 2] = turn.cos()
    c2w[..., 0, 2], c2w[..., 2, 0] = turn.sin(), -turn.sin()
    c2w[:, 1, :3, 3] = torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64)
    lens = torch.tensor([20.0, 20.0, 12.5, 7.5], dtype=torch.float64).expand(2, 2, 4)
    images = torch.rand(2, 2, 3, *SIZE, generator=torch.Generator().manual_seed(0)).double()
    return Views(images, Cameras(c2w, lens, SIZE))


def memory() -> ImageMemory:
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(2, TOKENS, DIMS.width, generator=generator).double()
    return ImageMemory(features, grid=GRID)


def started(**options: object) -> tuple[ObservedQueries, QueryState]:
    torch.manual_seed(0)
    config = ObservedQueries.Config.model_validate(options)
    queries = ObservedQueries(config, DIMS).double().eval()
    with torch.no_grad():
        for parameter in queries.depth_mlp.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
        return queries, queries(memory(), views())


def in_patches(maps: Tensor) -> Tensor:
    """(B, V, H, W, C) -> (B, M, P, P, C), by view, row and column."""
    parts = maps.unflatten(2, (GRID[1], PATCH)).unflatten(4, (GRID[2], PATCH))
    return parts.transpose(3, 4).flatten(1, 3)


@pytest.mark.parametrize("each", [1, 3])
def test_anchors_of_all_tokens_stand_on_the_rays_of_their_patches(each: int) -> None:
    queries, state = started(count=None, per_token=each, near=0.5, far=4.0, radius=0.7)
    x = (memory().features[:, :, None] + queries.slots).flatten(1, 2)
    torch.testing.assert_close(state.features, x)
    w = torch.sigmoid(queries.depth_mlp(x))
    z = 0.5**w * 4.0 ** (1 - w)
    given = views().cameras
    local = torch.einsum(
        "bvij,bvnj->bvni", given.w2c[..., :3, :3], state[CENTER].unflatten(1, (2, -1))
    )
    local = local + given.w2c[..., None, :3, 3]
    torch.testing.assert_close(local[..., 2].flatten(1), z[..., 0])
    places = 20.0 * local[..., :2] / local[..., 2:] + torch.tensor([12.5, 7.5])
    row, column = torch.meshgrid(torch.arange(4.0), torch.arange(6.0), indexing="ij")
    middles = PATCH * (torch.stack([column, row], -1).flatten(0, 1) + 0.5).double()
    middles = middles.repeat_interleave(each, 0).expand_as(places)
    torch.testing.assert_close(places, middles)
    radii = support_radius(state[RAW_RADIUS], queries.config)
    torch.testing.assert_close(radii, 0.7 * PATCH / math.sqrt(each) * z / 20.0)


def test_anchors_start_between_near_and_far_in_the_logarithm() -> None:
    queries = ObservedQueries(ObservedQueries.Config(count=None, near=0.2, far=3.2), DIMS).double()
    state = queries(memory(), views())
    depth = (state[CENTER][:, : TOKENS // 2] @ views().cameras.c2w[:, 0, :3, 2, None])[..., 0]
    torch.testing.assert_close(depth, torch.full_like(depth, math.sqrt(0.2 * 3.2)))


def test_a_number_of_anchors_is_spread_over_the_photos() -> None:
    queries, state = started(count=10, cells=4)
    again = queries(memory(), views())
    assert torch.equal(state[CENTER], again[CENTER])
    assert state.features.shape == (2, 10, DIMS.width)
    assert queries.count == 10
    side = math.sqrt(2 * SIZE[0] * SIZE[1] / 10)
    depth = support_radius(state[RAW_RADIUS], queries.config) * 20.0 / side
    for view in range(2):
        camera = views().cameras[:, view]
        local = state[CENTER][:, view::2] - camera.c2w[:, None, :3, 3]
        own = (local @ camera.c2w[:, :3, 2, None]).squeeze(-1)
        torch.testing.assert_close(own, depth[:, view::2, 0])


def test_tokens_of_a_footprint_make_a_query() -> None:
    """Two side by side in each of 4 x 3 tiles: their features, and the mean of their depths."""
    queries, state = started(count=24, tokens=2, cells=8)
    alone, of_tokens = started(count=None)
    weights = {n: w for n, w in queries.state_dict().items() if not n.startswith("apart_proj.")}
    alone.load_state_dict(weights)
    with torch.no_grad():
        of_tokens = alone(memory(), views())

    def by_tile(values_BMX: Tensor) -> tuple[Tensor, ...]:
        """The left and the right one, (B, N, ...); a query's view changes first."""
        found = values_BMX.unflatten(1, (2, 4, 3, 2)).flatten(2, 3).transpose(1, 2).flatten(1, 2)
        return found.unbind(2)

    left, right = by_tile(of_tokens.features)
    expected = (left + right) / 2 + queries.apart_proj((right - left) / 2)
    torch.testing.assert_close(state.features, expected, rtol=1e-5, atol=1e-6)
    cameras = views().cameras
    view = torch.arange(TOKENS) // (TOKENS // 2)
    local = of_tokens[CENTER] - cameras.c2w[:, view, :3, 3]
    depth = (local * cameras.c2w[:, view, :3, 2]).sum(-1, keepdim=True)
    left, right = by_tile(depth)
    own = state[CENTER] - cameras.c2w[:, torch.arange(24) % 2, :3, 3]
    found = (own * cameras.c2w[:, torch.arange(24) % 2, :3, 2]).sum(-1, keepdim=True)
    torch.testing.assert_close(found, (left * right).sqrt())


def test_far_is_behind_near() -> None:
    with pytest.raises(ValueError, match="far must be more than near"):
        ObservedQueries.Config(near=2.0, far=1.0)


@pytest.mark.parametrize(
    ("count", "tile"),  # rows and columns of 2 x 2 pixels in a footprint
    [(None, (2, 2)), (12, (4, 4)), (24, (2, 4))],
)
def test_gaussians_start_as_the_photo_that_they_stand_for(
    count: int | None, tile: tuple[int, int]
) -> None:
    """With a head of zeros, each lies on the ray of its 2 x 2 pixels and has their colour."""
    each = math.prod(tile)
    queries, state = started(count=count, cells=each)
    head = ColoredHead(ColoredHead.Config(gaussians_per_query=each), DIMS).double()
    torch.nn.init.zeros_(head.linear.weight)
    attributes = head(state)
    means = FootprintCenters(FootprintCenters.Config(), DIMS)(attributes.offsets, state)

    def of_queries(maps_BVHWC: Tensor) -> Tensor:
        parts = maps_BVHWC.unflatten(3, (-1, tile[1])).unflatten(2, (-1, tile[0]))
        found = parts.transpose(3, 4).flatten(4, 5).flatten(2, 3)
        return (found if count is None else found.transpose(1, 2)).flatten(1, 2)

    small = F.avg_pool2d(views().images.flatten(0, 1), 2).unflatten(0, (2, 2)).movedim(2, -1)
    expected = of_queries(small).clamp(0.02, 0.98)
    torch.testing.assert_close(attributes.colors, expected, rtol=0, atol=1e-6)
    halved = Cameras(views().cameras.c2w, views().cameras.intrinsics / 2, (8, 12))
    origins, rays = map(of_queries, camera_rays(halved))
    torch.testing.assert_close(F.normalize(means - origins, dim=-1), rays)
    radii = support_radius(state[RAW_RADIUS], queries.config)
    torch.testing.assert_close(
        attributes.scales, (0.8 / math.e * radii[..., None]).expand(attributes.scales.shape)
    )


def test_a_head_of_more_gaussians_starts_from_those_of_the_nearest_cells() -> None:
    """`init_from`: each of 2 x 2 cells has its channels in the four of 4 x 4 that divide it."""
    small, large = (
        ColoredHead(ColoredHead.Config(gaussians_per_query=count), DIMS) for count in (4, 16)
    )
    large.load_state_dict(large.adapted(small.state_dict()))
    features = torch.randn(2, TOKENS, DIMS.width, generator=torch.Generator().manual_seed(2))
    four, sixteen = (
        head.linear(features).unflatten(-1, (side, side, -1))
        for head, side in ((small, 2), (large, 4))
    )
    torch.testing.assert_close(sixteen, four.repeat_interleave(2, 2).repeat_interleave(2, 3))


def test_a_head_leaves_weights_that_are_not_its_own() -> None:
    """They are then refused by their names and shapes."""
    theirs = {"linear.weight": torch.zeros(13, 8), "fc.weight": torch.zeros(28, 8)}
    found = ColoredHead(ColoredHead.Config(), DIMS).adapted(theirs)
    assert {name: values.shape for name, values in found.items()} == {
        name: values.shape for name, values in theirs.items()
    }


def test_the_recipe_of_larger_photos_starts_from_the_shipped_model() -> None:
    recipe = resolve("rooms/landmark_128.yaml")
    changes = initialise(recipe.build_model(), recipe)
    assert "head.linear.weight: (112, 128) -> (224, 128)" in changes


def test_centres_add_offsets_in_radii() -> None:
    _, state = started(count=None, cells=4)
    centers = FootprintCenters(FootprintCenters.Config(offset="linear"), DIMS)
    offsets = torch.randn(2, TOKENS, 4, 3).double()
    moved = centers(offsets, state) - centers(torch.zeros_like(offsets), state)
    radii = support_radius(state[RAW_RADIUS], centers.config)
    axes = views().cameras.c2w[..., :3, :3].repeat_interleave(TOKENS // 2, 1)
    expected = torch.einsum("bnij,bnkj->bnki", axes, radii[..., None] * offsets)
    torch.testing.assert_close(moved, expected)
    assert state[FRAME].shape == (2, TOKENS, 3, 3)
    assert state[COLORS].shape == (2, TOKENS, 4, 3)


def test_refinement_steps_in_radii_along_the_axes_of_the_photo() -> None:
    _, state = started(count=None)
    ours, theirs = (
        kind(kind.Config(), DIMS).double() for kind in (FramedRefinement, AnchorRefinement)
    )
    ours.load_state_dict(theirs.state_dict())
    steps = theirs(state)[CENTER] - state[CENTER]
    axes = views().cameras.c2w[..., :3, :3].repeat_interleave(TOKENS // 2, 1)
    radii = support_radius(state[RAW_RADIUS], ours.config)
    expected = torch.einsum("bnij,bnj->bni", axes, radii * steps)
    torch.testing.assert_close(ours(state)[CENTER] - state[CENTER], expected)
    assert torch.equal(ours(state)[RAW_RADIUS], theirs(state)[RAW_RADIUS])


def cloud(count: int = 40) -> QueryState:
    generator = torch.Generator().manual_seed(2)
    x, center = (torch.randn(2, count, n, generator=generator).double() for n in (DIMS.width, 3))
    return QueryState(x, {CENTER: center})


@pytest.mark.parametrize("pairs", [1 << 22, 100])
def test_neighbours_are_the_nearest(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("qgs_landmark.neighbours.MAX_PAIRS", pairs)
    center = cloud()[CENTER]
    index, seen = nearest(center, 5, None)
    assert seen is None
    for scene in range(2):
        for anchor in range(40):
            order = sorted(
                range(40), key=lambda j: math.dist(center[scene, anchor], center[scene, j])
            )
            assert index[scene, anchor].tolist() == order[:5]


def attention(count: int) -> NeighbourAttention:
    torch.manual_seed(0)
    module = NeighbourAttention(NeighbourAttention.Config(count=count), DIMS).double()
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return module


def test_what_an_anchor_reads_is_written_out() -> None:
    state, module = cloud(), attention(6)
    index, _ = nearest(state[CENTER], 6, None)
    q, k, v = module.attention.project(module.norm(state.features))
    read, where = torch.zeros(2, 40, 2, 8).double(), torch.zeros(2, 40, 2, 5).double()
    for scene in range(2):
        for anchor in range(40):
            near = index[scene, anchor]
            steps = state[CENTER][scene, near] - state[CENTER][scene, anchor]
            reach = steps.norm(dim=-1).max()
            lengths = steps.norm(dim=-1, keepdim=True) / reach
            place = torch.cat([steps / reach, lengths, reach.log().expand_as(lengths)], -1)
            for head in range(2):
                logits = k[scene, head, near] @ q[scene, head, anchor] / math.sqrt(8)
                share = (logits + module.place_mlp(place)[:, head]).softmax(0)
                read[scene, anchor, head] = share @ v[scene, head, near]
                where[scene, anchor, head] = share @ place
    expected = module.attention.proj(read.flatten(2)) + module.place_proj(where.flatten(2))
    torch.testing.assert_close(module(state), expected, rtol=1e-4, atol=1e-3)


def test_with_all_anchors_and_without_places_it_is_self_attention() -> None:
    state, module = cloud(), attention(100)
    for part in (module.place_mlp.fc2.weight, module.place_mlp.fc2.bias, module.place_proj.weight):
        torch.nn.init.zeros_(part)
    torch.testing.assert_close(module(state), module.attention(module.norm(state.features)))


def test_nobody_reads_what_is_no_query() -> None:
    state, module = cloud(), attention(6)
    mask = torch.rand(2, 40, generator=torch.Generator().manual_seed(0)) < 0.6
    read = module(state.replace(mask=mask))
    for scene in range(2):
        alone = QueryState(
            *(
                {CENTER: x} if x.shape[-1] == 3 else x
                for x in (
                    state.features[scene : scene + 1, mask[scene]],
                    state[CENTER][scene : scene + 1, mask[scene]],
                )
            )
        )
        torch.testing.assert_close(read[scene, mask[scene]], module(alone)[0])


def test_errors_are_added_to_keys_and_values() -> None:
    torch.manual_seed(0)
    feedback = RenderedFeedback(RenderedFeedback.Config(shrink=2, cells=2), DIMS).double()
    with torch.no_grad():
        feedback.marker += torch.randn(DIMS.width)
    given = feedback.compared(views())
    torch.testing.assert_close(
        given.images, views().images.unflatten(3, (8, 2)).unflatten(5, (12, 2)).mean((4, 6))
    )
    keys, values = torch.randn(2, 2, 2, TOKENS, 8).double()
    told = ImageMemory(memory().features, keys, values, grid=GRID)
    rgb, alpha, depth = (torch.rand(2, 2, c, 8, 12).double() for c in (3, 1, 1))
    state, after = feedback(cloud(), told, Rendering(rgb, alpha, depth), given)
    torch.testing.assert_close(state.features, cloud().features + feedback.marker)
    wrong = torch.cat([4 * (given.images - rgb), rgb, alpha], 2)  # 2 x 2 cells a token: all pixels
    shuffled = F.pixel_unshuffle(wrong.flatten(0, 1), 2)
    x = F.conv2d(shuffled, feedback.embedding.weight, feedback.embedding.bias, padding=1)
    rows = F.gelu(x).flatten(2).mT.unflatten(0, (2, 2)).flatten(1, 2)
    k, v = F.linear(rows, feedback.kv_proj.weight, feedback.kv_proj.bias).chunk(2, -1)
    assert after.keys is not None
    assert after.values is not None
    torch.testing.assert_close(after.keys, keys + split_heads(k, 2))
    torch.testing.assert_close(after.values, values + split_heads(v, 2))
    assert after.features is told.features


def test_training_draws_its_rounds() -> None:
    feedback = RenderedFeedback(RenderedFeedback.Config(rounds=3), DIMS)
    torch.manual_seed(0)
    assert {feedback.drawn() for _ in range(50)} == {1, 2, 3}
    assert feedback.rounds == 3
