"""Every option does what it says: each component, with options off their defaults, by formula."""

import pytest
import torch
import torch.nn.functional as F
from qgs_ellipsoid.anchors import EllipsoidQueries
from qgs_ellipsoid.cross_attention import EllipsoidCrossAttention
from qgs_ellipsoid.fields import RAW_RADII, ROTATION
from qgs_ellipsoid.head import EllipsoidHead, radii_along
from qgs_ellipsoid.refinement import EllipsoidRefinement
from qgs_locus.anchors import FrustumCenters
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.fields import CENTER
from torch import Tensor

from qgs.components import posact
from qgs.contracts import ModelDims
from qgs.geometry.rays import camera_rays, patch_rays, plucker_rays
from qgs.types import Cameras, ImageMemory, QueryState

DIMS = ModelDims(width=16, heads=2, depth=2)
CHOSEN = {"sigma0": 0.3, "sigma_sq_min": 1e-5, "bias_min": -7.0, "gamma_init": 0.4}
OFFSET = {"radius_bound": "offset", "radius_min": 0.05}


def _radii(raw: Tensor) -> Tensor:
    return F.softplus(raw) + 0.05


def _state(count: int = 6) -> QueryState:
    """Turned anchors of unequal radii in front of the cameras."""
    center = torch.randn(2, count, 3) * 0.4 + torch.tensor([0.0, 0.0, 1.5])
    quats = F.normalize(torch.randn(2, count, 4), dim=-1)
    fields = {CENTER: center, ROTATION: quats, RAW_RADII: torch.randn(2, count, 3) - 1}
    return QueryState(torch.randn(2, count, DIMS.width), fields)


def _cameras() -> Cameras:
    c2w = torch.eye(4).repeat(2, 2, 1, 1)
    c2w[:, 1, :3, 3] = torch.tensor([0.5, 0.1, 0.0])
    return Cameras(c2w, torch.tensor([20.0, 20.0, 8.0, 6.0]).expand(2, 2, 4).clone(), (12, 16))


def _memory(rays: Tensor, grid: tuple[int, int, int]) -> ImageMemory:
    tokens = rays.shape[1]
    heads = torch.randn(2, 2, tokens, 8)
    return ImageMemory(torch.randn(2, tokens, 16), heads, heads.flip(0), rays, grid)


def test_attention_pictures_and_decoding_speak_of_one_ellipsoid() -> None:
    state, cameras = _state(), _cameras()
    memory = _memory(patch_rays(plucker_rays(cameras), 1), (2, 12, 16))
    attention = EllipsoidCrossAttention(EllipsoidCrossAttention.Config(**CHOSEN, **OFFSET), DIMS)
    bias = attention.bias(state, memory).dense()
    axes = EllipsoidQueries(EllipsoidQueries.Config(**OFFSET), DIMS).support(state).axes
    origins, directions = (x.flatten(1, 3) for x in camera_rays(cameras))
    along = torch.linspace(0, 6, 20_001)[:, None]
    gamma = F.softplus(torch.tensor(0.4))
    for query, ray in ((0, 0), (3, 100), (5, 383), (2, 200)):
        points = origins[1, ray] + along * directions[1, ray] - state[CENTER][1, query]
        in_ball = torch.linalg.solve(0.3 * axes[1, query], points.T)
        least = in_ball.square().sum(0).min()
        expected = gamma * (-0.5 * least).clamp(-7.0, 0.0)
        torch.testing.assert_close(bias[1, query, ray], expected, rtol=1e-3, atol=1e-3)
    assert bias.min() == -7.0 * gamma
    assert bias.max() > -1.0


def test_a_fixed_bandwidth_is_that_of_locusgs() -> None:
    state, memory = _state(), _memory(patch_rays(plucker_rays(_cameras()), 4), (2, 3, 4))
    options = {"bandwidth": "fixed", "sigma0": 0.3, "bias_min": -7.0}
    ours = EllipsoidCrossAttention(EllipsoidCrossAttention.Config(**options), DIMS)
    theirs = RayBiasedCrossAttention(RayBiasedCrossAttention.Config(**options), DIMS)
    assert torch.equal(ours.bias(state, memory).dense(), theirs.bias(state, memory).dense())
    assert set(EllipsoidCrossAttention.fields_read(ours.config)) == set(
        RayBiasedCrossAttention.fields_read(theirs.config)
    )


@pytest.mark.parametrize(
    ("options", "step"),
    [
        ({"center_step": "linear"}, lambda t: t),
        ({"input_limit": 0.1, "output_limit": None}, lambda t: posact(t, 0.1, None)),
        ({"output_limit": 0.05}, lambda t: posact(t, 100.0, 0.05)),
    ],
)
def test_the_step_of_a_centre_follows_its_options(options: dict, step) -> None:
    refinement, state = EllipsoidRefinement(EllipsoidRefinement.Config(**options), DIMS), _state()
    expected = state[CENTER] + step(refinement.center_mlp(state.features))
    torch.testing.assert_close(refinement(state)[CENTER], expected)


def test_quaternions_of_no_use_become_the_identity() -> None:
    head, state = EllipsoidHead(EllipsoidHead.Config(gaussians_per_query=2), DIMS), _state()
    with torch.no_grad():
        head.linear.weight.zero_()
        head.linear.bias.view(2, 14)[1, 9:13] = 1e-6
    out = head(state)
    torch.testing.assert_close(out.quats[..., 0, :], state[ROTATION])
    torch.testing.assert_close(out.quats.norm(dim=-1), torch.ones(2, 6, 2))
    halves = torch.full((2, 6, 2, 4), 0.5)
    along = radii_along(F.softplus(state[RAW_RADII]), halves)[:, :, 1]
    torch.testing.assert_close(out.scales[:, :, 1], 0.075 / torch.e * along)


def test_queries_give_what_they_learned_in_the_form_that_they_promise() -> None:
    options = {**OFFSET, "count": 500, "std": 2.0, "init_radii": (0.1, 0.2, 0.4)}
    config = EllipsoidQueries.Config(**options, center_init=FrustumCenters(kind="frustum"))
    queries = EllipsoidQueries(config, DIMS)
    assert queries.features.std().item() == pytest.approx(2.0, rel=0.1)
    assert (queries.center[:, 2] >= 0.3).all()
    with torch.no_grad():
        for parameter in queries.parameters():
            parameter += torch.randn_like(parameter)
    state = queries.start(2)
    torch.testing.assert_close(state[ROTATION].norm(dim=-1), torch.ones(2, 500))
    torch.testing.assert_close(state[ROTATION][1], F.normalize(queries.rotation, dim=-1))
    assert torch.equal(state[CENTER][1], queries.center)
    lengths = queries.support(state).axes.norm(dim=-2)
    torch.testing.assert_close(lengths[1], _radii(queries.raw_radii))
