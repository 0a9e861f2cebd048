"""Every formula against what is written out by hand: starts, Gaussians, neighbours, errors."""

import math

import torch
import torch.nn.functional as F
from odd_views import in_tiles
from qgs_anchors.landmark.footprint import ColoredHead, FootprintCenters, FramedRefinement
from qgs_anchors.landmark.gradient import GradientFeedback
from qgs_anchors.landmark.neighbours import NeighbourAttention
from qgs_anchors.landmark.observed import ObservedQueries
from qgs_anchors.landmark.rendered import RenderedFeedback
from qgs_locus.fields import CENTER, RAW_RADIUS, support_radius
from qgs_locus.refinement import AnchorRefinement
from small_parts import made, shaken
from torch.testing import assert_close
from walk import arc

from qgs.geometry.rays import camera_rays
from qgs.geometry.transforms import to_camera, to_pixels
from qgs.recipe import resolve
from qgs.tokengs.blocks import split_heads
from qgs.train.initial import initialise
from qgs.types import Cameras, ImageMemory, QueryState, Rendering, Views

GRID = (2, 4, 6)
SIZE = (16, 24)
PATCH = 4
TOKENS = math.prod(GRID)
BY_PHOTO = torch.arange(TOKENS) // (TOKENS // 2)
"""Photos of the tokens; queries of a number take photos in turn."""


def drawn(seed, *shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).double()


LENS = torch.tensor([20.0, 20.0, 12.5, 7.5]).double()
C2W = arc([10, 50, 120, 200], 3, 0.2).unflatten(0, (2, 2))
VIEWS = Views(drawn(0, 2, 2, 3, *SIZE).sigmoid(), Cameras(C2W, LENS.expand(2, 2, 4), SIZE))
"""Two scenes of two photos, the cameras turned and moved."""
AXES = C2W[:, BY_PHOTO, :3, :3]
"""Of the photos of the tokens."""
HALVED = Views(
    F.avg_pool3d(VIEWS.images, (1, 2, 2)), Cameras(C2W, VIEWS.cameras.intrinsics / 2, (8, 12))
)
MEMORY = ImageMemory(drawn(1, 2, TOKENS, 16), grid=GRID)


@torch.no_grad()
def started(**options):
    queries = made(ObservedQueries, **options).double().eval()
    shaken(queries.depth_mlp)
    return queries, queries(MEMORY, VIEWS)


def in_photos(state, view_N):
    """Depths (B, N, 1) of anchors in these photos, and their pixels there."""
    local = to_camera(state[CENTER], VIEWS.cameras)[:, view_N, torch.arange(len(view_N))]
    return local[..., 2:], to_pixels(local, LENS)


def test_anchors_of_all_tokens_stand_on_the_rays_of_their_patches():
    corners = torch.cartesian_prod(torch.arange(4), torch.arange(6)).flip(-1).repeat(2, 1)
    for each, bound in ((1, "floor"), (3, "offset")):
        options = {"near": 0.5, "far": 4.0, "radius": 0.7, "radius_bound": bound}
        queries, state = started(count=None, per_token=each, radius_min=0.01, **options)
        x = (MEMORY.features[:, :, None] + queries.slots).flatten(1, 2)
        assert_close(state.features, x)
        w = torch.sigmoid(queries.depth_mlp(x))
        z, places = in_photos(state, BY_PHOTO.repeat_interleave(each))
        middles = PATCH * (corners + 0.5).double().repeat_interleave(each, 0)
        radii = support_radius(state[RAW_RADIUS], queries.config)
        wanted = (
            0.5**w * 4.0 ** (1 - w),
            middles.expand_as(places),
            0.7 * PATCH / each**0.5 * z / 20,
        )
        assert_close((z, places, radii), wanted)


def test_tokens_of_a_footprint_make_a_query():
    """Two side by side in each of 4 x 3 tiles: their features, and the mean of their depths."""
    queries, state = started(count=24, tokens=2, cells=8)
    alone, _ = started(count=None)
    weights = {n: w for n, w in queries.state_dict().items() if not n.startswith("apart_proj.")}
    alone.load_state_dict(weights)
    of_tokens = alone(MEMORY, VIEWS)

    left, right = in_tiles(of_tokens.features.unflatten(1, GRID), 1, 2, True).unbind(2)
    expected = (left + right) / 2 + queries.apart_proj((right - left) / 2)
    assert_close(state.features, expected, rtol=1e-5, atol=1e-6)
    depths, _ = in_photos(of_tokens, BY_PHOTO)
    left, right = in_tiles(depths.unflatten(1, GRID), 1, 2, True).unbind(2)
    z, _ = in_photos(state, torch.arange(24) % 2)
    assert_close(z, (left * right).sqrt())


def test_gaussians_start_as_the_photo_that_they_stand_for():
    """With a head of zeros, each lies on the ray of its 2 x 2 pixels and has their colour."""
    for count, rows, columns in ((None, 2, 2), (12, 4, 4), (24, 2, 4)):
        queries, state = started(count=count, cells=rows * columns)
        head = made(ColoredHead, gaussians_per_query=rows * columns).double()
        torch.nn.init.zeros_(head.linear.weight)
        attributes = head(state)
        means = made(FootprintCenters)(attributes.offsets, state)
        maps = (HALVED.images.movedim(2, -1), *camera_rays(HALVED.cameras))
        colors, origins, rays = (in_tiles(x, rows, columns, bool(count)) for x in maps)
        assert_close(attributes.colors, colors.clamp(0.02, 0.98), rtol=0, atol=1e-6)
        assert_close(F.normalize(means - origins, dim=-1), rays)
        radii = support_radius(state[RAW_RADIUS], queries.config)[..., None]
        assert_close(attributes.scales, (0.8 / math.e * radii).expand_as(attributes.scales))


def test_a_head_of_more_gaussians_starts_from_those_of_the_nearest_cells():
    """`init_from`: each of 2 x 2 cells has its channels in the four of 4 x 4 that divide it."""
    small, large = (made(ColoredHead, gaussians_per_query=count).double() for count in (4, 16))
    large.load_state_dict(large.adapted(small.state_dict()))
    four, sixteen = (
        head.linear(MEMORY.features).unflatten(-1, (side, side, -1))
        for head, side in ((small, 2), (large, 4))
    )
    assert_close(sixteen, four.repeat_interleave(2, 2).repeat_interleave(2, 3))


def test_the_recipe_of_larger_photos_starts_from_the_shipped_model():
    recipe = resolve("rooms/landmark_128.yaml")
    changes = initialise(recipe.build_model(), recipe)
    assert "head.linear.weight: (112, 128) -> (224, 128)" in changes


def test_centres_add_offsets_in_radii():
    _, state = started(count=None, cells=4)
    centers = made(FootprintCenters, offset="linear")
    offsets = drawn(3, 2, TOKENS, 4, 3)
    moved = centers(offsets, state) - centers(torch.zeros_like(offsets), state)
    radii = support_radius(state[RAW_RADIUS], centers.config)[..., None]
    assert_close(moved, torch.einsum("bnij,bnkj->bnki", AXES, radii * offsets))


def test_refinement_steps_in_radii_along_the_axes_of_the_photo():
    _, state = started(count=None)
    ours, theirs = (made(kind).double() for kind in (FramedRefinement, AnchorRefinement))
    ours.load_state_dict(theirs.state_dict())
    radii = support_radius(state[RAW_RADIUS], ours.config)
    steps = radii * (theirs(state)[CENTER] - state[CENTER])
    assert_close(ours(state)[CENTER] - state[CENTER], torch.einsum("bnij,bnj->bni", AXES, steps))
    assert torch.equal(ours(state)[RAW_RADIUS], theirs(state)[RAW_RADIUS])


CLOUD = QueryState(drawn(2, 2, 40, 16), {CENTER: drawn(3, 2, 40, 3)})
STEPS = CLOUD[CENTER][:, None] - CLOUD[CENTER][:, :, None]
"""From each anchor to each."""


def test_what_an_anchor_reads_of_the_nearest_is_written_out(monkeypatch):
    for count, pairs in ((6, 1 << 22), (6, 100), (100, 1 << 22)):
        monkeypatch.setattr("qgs_anchors.landmark.neighbours.MAX_PAIRS", pairs)
        module = shaken(made(NeighbourAttention, count=count), 0.1)
        index = STEPS.norm(dim=-1).argsort(-1)[..., :count]
        scene = torch.arange(2)[:, None, None]
        steps = STEPS[scene, torch.arange(40)[:, None], index]
        reach = steps.norm(dim=-1, keepdim=True).amax(2, keepdim=True)
        steps = steps / reach
        lengths = steps.norm(dim=-1, keepdim=True)
        place = torch.cat([steps, lengths, reach.log().expand_as(lengths)], -1)
        q, k, v = (x.transpose(1, 2) for x in module.attention.project(module.norm(CLOUD.features)))
        logits = (k[scene, index] * q[:, :, None]).sum(-1) / math.sqrt(8)
        share = (logits + module.place_mlp(place)).softmax(2)[..., None]
        read, where = (
            (share * x).sum(2).flatten(2) for x in (v[scene, index], place[..., None, :])
        )
        expected = module.attention.proj(read) + module.place_proj(where)
        assert_close(module(CLOUD), expected, rtol=1e-4, atol=1e-3)


def test_steps_against_the_gradient_are_written_out():
    """If features f are the image, the gradient is 2 (f - photo); that of padding is 0."""
    feedback = shaken(made(GradientFeedback, steps=2))
    photos_BND = VIEWS.images.reshape(2, -1, 16)
    start_BND = x_BND = drawn(8, *photos_BND.shape)
    step_BND = 0
    for _ in range(2):
        g_BND = x_BND - photos_BND
        g_BND = g_BND / g_BND.square().mean((1, 2), keepdim=True).sqrt()
        step_BND = 0.5 * step_BND - feedback.rate * g_BND.sign() * (1 + g_BND.abs()).log()
        x_BND = x_BND + step_BND

    def render(features, _):
        rgb = features[:, :-7].reshape(VIEWS.images.shape)
        return Rendering(rgb, rgb[:, :, :1], rgb[:, :, :1])

    mask_BN = (torch.arange(151) < 144).expand(2, -1)
    padded = QueryState(F.pad(start_BND, (0, 0, 0, 7)), mask=mask_BN)
    state, _ = feedback(padded, MEMORY, VIEWS, lambda given: given.features, render)
    assert_close(state.features[:, :-7], x_BND + feedback.marker)


def test_errors_are_added_to_keys_and_values():
    feedback = shaken(made(RenderedFeedback, shrink=2, cells=2))
    given = feedback.shrunk(VIEWS)
    keys, values = drawn(4, 2, 2, 2, TOKENS, 8)
    told = ImageMemory(MEMORY.features, keys, values, grid=GRID)
    rgb, alpha, depth = drawn(5, 2, 2, 5, 8, 12).sigmoid().tensor_split([3, 4], 2)
    found = Rendering(rgb, alpha, depth)
    state, after = feedback(CLOUD, told, VIEWS, lambda state: None, lambda *given: found)
    assert_close(state.features, CLOUD.features + feedback.marker)
    wrong = torch.cat([4 * (given.images - rgb), rgb, alpha], 2)  # 2 x 2 cells a token: all pixels
    shuffled = F.pixel_unshuffle(wrong.flatten(0, 1), 2)
    x = F.gelu(feedback.embedding(shuffled)).flatten(2).mT.unflatten(0, (2, 2)).flatten(1, 2)
    k, v = feedback.kv_proj(x).chunk(2, -1)
    assert_close((after.keys, after.values), (keys + split_heads(k, 2), values + split_heads(v, 2)))
    assert after.features is told.features
