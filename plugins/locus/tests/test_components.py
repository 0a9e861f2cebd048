"""Anchors, refinement and decoding, each on its own."""

import torch
import torch.nn.functional as F
from qgs_locus.anchors import AnchoredQueries, FrustumCenters, NormalCenters
from qgs_locus.decoding import RadiusScaledCenters
from qgs_locus.fields import CENTER, RAW_RADIUS, RadiusOptions, raw_radius_of, support_radius
from small_parts import made
from torch.testing import assert_close

from qgs import QueryState


def test_a_radius_is_read_in_two_ways_and_made_raw():
    radii = torch.tensor([0.05, 0.3, 1.0, 30.0])
    raw = torch.tensor([*map(raw_radius_of, radii.tolist()), -20.0])
    floor = support_radius(raw, RadiusOptions())
    offset = support_radius(raw, RadiusOptions(radius_bound="offset"))
    assert_close(floor, torch.cat([radii, torch.tensor([1e-3])]))
    assert_close(offset, torch.cat([radii + 1e-3, torch.tensor([1e-3])]))


def test_queries_start_as_configured():
    start = NormalCenters(mean=(0.0, 0.0, 2.0), std=0.5)
    queries = made(AnchoredQueries, count=4000, init_radius=0.3, center_init=start)
    support = queries.support(queries.start(3))
    seen = torch.stack([support.centers.mean((0, 1)), support.centers[2].std(0)])
    assert_close(seen, torch.tensor([[0.0, 0, 2], [0.5, 0.5, 0.5]]), atol=0.03, rtol=0)
    assert_close(support.axes, 0.3 * torch.eye(3).expand(3, 4000, 3, 3))


def test_frustum_centers_lie_in_the_frustum():
    centers = FrustumCenters(kind="frustum", depth=(0.5, 2.0), slope=0.7).sample(500)
    z = centers[:, 2:]
    assert 0.5 <= z.min() <= z.max() <= 2.0
    assert (centers[:, :2].abs() <= 0.7 * z).all()


def test_linear_offsets_count_in_radii():
    fields = {CENTER: torch.randn(2, 5, 3), RAW_RADIUS: torch.randn(2, 5, 1)}
    state = QueryState(torch.randn(2, 5, 16), fields)
    offsets = torch.randn(2, 5, 3, 3)
    means = made(RadiusScaledCenters, offset="linear")(offsets, state)
    radius = F.softplus(state[RAW_RADIUS])[:, :, None]
    assert_close(means, state[CENTER][:, :, None] + radius * offsets)
