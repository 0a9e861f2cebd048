"""Anchors, refinement and decoding, each on its own."""

import math

import pytest
import torch
from qgs_locus.anchors import AnchoredQueries, FrustumCenters, NormalCenters
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.decoding import AnchorOffsetCenters, RadiusScaledCenters
from qgs_locus.fields import RadiusOptions, raw_radius_of, support_radius
from qgs_locus.refinement import AnchorRefinement
from qgs_locus.self_attention import sine_embedding
from refusals import refused

from qgs import QueryState
from qgs.components import posact
from qgs.composer import RecipeProblem, resolve
from qgs.contracts import ModelDims

DIMS = ModelDims(width=16, heads=2, depth=2)


def _state(batch: int = 2, count: int = 5) -> QueryState:
    fields = {
        "anchor.center": torch.randn(batch, count, 3),
        "anchor.raw_radius": torch.randn(batch, count, 1),
    }
    return QueryState(torch.randn(batch, count, DIMS.width), fields)


@pytest.mark.parametrize("radius", [0.05, 0.3, 1.0, 30.0])
def test_raw_radius_inverts_softplus(radius: float) -> None:
    raw = torch.tensor(raw_radius_of(radius))
    torch.testing.assert_close(support_radius(raw, RadiusOptions()), torch.tensor(radius))


def test_the_two_readings_of_a_radius() -> None:
    raw = torch.tensor([-20.0, 0.0])
    floor = support_radius(raw, RadiusOptions())
    offset = support_radius(raw, RadiusOptions(radius_bound="offset"))
    torch.testing.assert_close(floor, torch.tensor([1e-3, math.log(2)]))
    torch.testing.assert_close(offset, torch.tensor([1e-3, math.log(2) + 1e-3]), atol=1e-8, rtol=0)


def test_queries_start_as_configured() -> None:
    config = AnchoredQueries.Config(
        count=4000, init_radius=0.3, center_init=NormalCenters(mean=(0.0, 0.0, 2.0), std=0.5)
    )
    queries = AnchoredQueries(config, DIMS)
    state = queries.start(3)
    support = queries.support(state)
    assert state["anchor.center"].shape == (3, 4000, 3)
    torch.testing.assert_close(
        support.centers[0].mean(0), torch.tensor([0.0, 0, 2]), atol=0.05, rtol=0
    )
    torch.testing.assert_close(support.centers[0].std(0), torch.full((3,), 0.5), atol=0.03, rtol=0)
    torch.testing.assert_close(support.axes, 0.3 * torch.eye(3).expand(3, 4000, 3, 3))


def test_queries_without_radius_provide_none() -> None:
    config = AnchoredQueries.Config(count=4, radius=False)
    assert set(AnchoredQueries.fields_written(config)) == {"anchor.center"}
    assert set(AnchoredQueries(config, DIMS).start(1).fields) == {"anchor.center"}


def test_frustum_centers_lie_in_the_frustum() -> None:
    centers = FrustumCenters(kind="frustum", depth=(0.5, 2.0), slope=0.7).sample(500)
    z = centers[:, 2:]
    assert z.min() >= 0.5
    assert z.max() <= 2.0
    assert (centers[:, :2].abs() <= 0.7 * z).all()


def test_refinement_moves_only_what_it_is_told_to() -> None:
    state = _state()
    before = {name: field.clone() for name, field in state.fields.items()}
    for center, radius in ((True, False), (False, True), (True, True)):
        config = AnchorRefinement.Config(center=center, radius=radius)
        refined = AnchorRefinement(config, DIMS)(state)
        assert refined.features is state.features
        moved = {name: not torch.equal(refined[name], before[name]) for name in before}
        assert moved == {"anchor.center": center, "anchor.raw_radius": radius}
    for name, field in before.items():
        assert torch.equal(state[name], field), "the state given must stay as it was"


def test_a_refinement_that_starts_at_zero_can_learn() -> None:
    refinement = AnchorRefinement(AnchorRefinement.Config(zero_init=True), DIMS)
    state = _state()
    refined = refinement(state)
    assert torch.equal(refined["anchor.center"], state["anchor.center"])
    (refined["anchor.center"].sum() + refined["anchor.raw_radius"].sum()).backward()
    assert refinement.center_mlp.fc2.weight.grad.abs().sum() > 0
    assert refinement.radius_mlp.fc2.weight.grad.abs().sum() > 0


def test_centers_follow_their_formulas() -> None:
    state, offsets = _state(), torch.randn(2, 5, 3, 3)
    center = state["anchor.center"][:, :, None]
    radius = torch.nn.functional.softplus(state["anchor.raw_radius"])[:, :, None]
    moved = AnchorOffsetCenters(AnchorOffsetCenters.Config(), DIMS)(offsets, state)
    scaled = RadiusScaledCenters(RadiusScaledCenters.Config(), DIMS)(offsets, state)
    linear = RadiusScaledCenters(RadiusScaledCenters.Config(offset="linear"), DIMS)(offsets, state)
    torch.testing.assert_close(moved, center + posact(offsets))
    torch.testing.assert_close(scaled, center + radius * posact(offsets))
    torch.testing.assert_close(linear, center + radius * offsets)


def test_sine_embedding_starts_with_the_plain_angle() -> None:
    position = torch.tensor([[-1.0, 0.0, 0.5]])
    embedding = sine_embedding(position).view(3, 128)
    angle = (position[0] + 1) * math.pi
    torch.testing.assert_close(embedding[:, 0], angle.sin(), atol=1e-5, rtol=0)
    torch.testing.assert_close(embedding[:, 1], angle.cos(), atol=1e-5, rtol=0)


def test_bandwidths_have_their_floor() -> None:
    attention = RayBiasedCrossAttention(RayBiasedCrossAttention.Config(), DIMS)
    raw = torch.tensor([[[-20.0], [20.0]]])
    state = _state(1, 2).replace(fields={"anchor.raw_radius": raw})
    torch.testing.assert_close(attention.sigma_sq(state), torch.tensor([[[1e-3], [4.0]]]))
    fixed = RayBiasedCrossAttention(RayBiasedCrossAttention.Config(bandwidth="fixed"), DIMS)
    assert fixed.sigma_sq(state) == pytest.approx(0.01)
    assert "anchor.raw_radius" not in RayBiasedCrossAttention.fields_read(fixed.config)


LOCUS = {"recipe": 1, "plugins": ["locus"]}
ANCHORED = {"queries": {"type": "locus/anchored"}}


def problem_of(model: dict) -> RecipeProblem:
    return refused({**LOCUS, "model": model})


@pytest.mark.parametrize(
    ("model", "path"),
    [
        ({"decoder": {"refinement": {"center": False, "radius": False}}}, ""),
        ({"decoder": {"refinement": {"center_step": "linear", "input_limit": 7.0}}},
         ".input_limit"),
        ({"decoder": {"refinement": {"radius": False, "radius_min": 0.5}}}, ".radius_min"),
        ({"centers": {"type": "locus/anchor_offset", "offset": "linear", "output_limit": None}},
         ".output_limit"),
        ({"decoder": {"cross_attention": {"bandwidth": "fixed", "sigma_sq_min": 0.5}}},
         ".sigma_sq_min"),
        ({"queries": {"type": "locus/anchored", "radius": False, "init_radius": 2.0}},
         ".init_radius"),
    ],
)  # fmt: skip
def test_options_without_effect_are_refused(model: dict, path: str) -> None:
    kinds = {"refinement": "locus/refine", "cross_attention": "locus/ray_biased"}
    for slot, options in model.get("decoder", {}).items():
        model["decoder"] = {slot: {"type": kinds[slot], **options}}
    problem = problem_of({**ANCHORED, **model})
    assert problem.option.endswith(path)
    assert "no effect" in problem.reason or "nothing is refined" in problem.reason


def test_idle_options_at_their_defaults_compose_again() -> None:
    centers = {"type": "locus/anchor_offset", "offset": "linear"}
    decoder = {"cross_attention": {"type": "locus/ray_biased", "bandwidth": "fixed"}}
    model = {"queries": {"type": "locus/anchored", "radius": False}, "centers": centers}
    recipe = resolve({**LOCUS, "model": {**model, "decoder": decoder}})
    assert resolve(recipe.tree).tree == recipe.tree


@pytest.mark.parametrize("depth", [[0.0, 1.0], [2.0, 1.0], [-1.0, 1.0], [1.0]])
def test_frustum_needs_ordered_positive_depths(depth: list[float]) -> None:
    queries = {"type": "locus/anchored", "center_init": {"kind": "frustum", "depth": depth}}
    problem = problem_of({"queries": queries})
    assert problem.option == "model.queries.center_init.depth"
