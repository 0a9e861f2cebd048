"""With three equal radii and a shape that does not turn it is LocusGS, in every tensor."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from qgs_ellipsoid.conversion import from_locus
from qgs_ellipsoid.fields import RAW_RADII, ROTATION
from qgs_locus.anchors import AnchoredQueries
from torch import Tensor

from qgs import Cameras, QueryGaussianModel, Views, compose
from qgs.contracts import ModelDims
from qgs.types import LayerPrediction

LOCUS: dict[str, Any] = {
    "recipe": 1,
    "plugins": ["locus"],
    "model": {
        "width": 48,
        "heads": 3,
        "encoder": {"depth": 1},
        "queries": {"type": "locus/anchored", "count": 40, "std": 0.5, "init_radius": 0.4},
        "decoder": {
            "depth": 3,
            "layer_scale": 0.5,
            "cross_attention": {"type": "locus/ray_biased", "gamma_init": 0.5},
            "self_attention": {"type": "locus/anchor_aware"},
            "refinement": {"type": "locus/refine"},
        },
        "head": {"gaussians_per_query": 4, "init_std": 0.1},
        "centers": {"type": "locus/radius_scaled"},
        "supervision": {"layers": [1, 2, 3]},
        "renderer": {"type": "qgs/torch"},
    },
}


def _ellipsoid(radius_refined: bool, bound: str) -> dict[str, Any]:
    radius = {"radius_bound": bound}
    model, decoder = LOCUS["model"], LOCUS["model"]["decoder"]
    refined = {"rotation": False, "radius": radius_refined, **(radius if radius_refined else {})}
    decoder = decoder | {
        "cross_attention": {"type": "ellipsoid/ray_biased", "gamma_init": 0.5, **radius},
        "refinement": {"type": "ellipsoid/refine", **refined},
    }
    changed = {
        "queries": {"type": "ellipsoid/anchored", "count": 40, "std": 0.5, **radius},
        "decoder": decoder,
        "centers": {"type": "ellipsoid/axis_scaled", **radius},
    }
    return {**LOCUS, "plugins": ["locus", "ellipsoid"], "model": model | changed}


def _locus(radius_refined: bool, bound: str) -> dict[str, Any]:
    radius = {"radius_bound": bound}
    model, decoder = LOCUS["model"], LOCUS["model"]["decoder"]
    refined = {"radius": radius_refined, **(radius if radius_refined else {})}
    changed = {
        "queries": model["queries"] | radius,
        "decoder": decoder
        | {
            "cross_attention": decoder["cross_attention"] | radius,
            "refinement": decoder["refinement"] | refined,
        },
        "centers": model["centers"] | radius,
    }
    return {**LOCUS, "model": model | changed}


def _photos() -> Views:
    c2w = torch.eye(4).repeat(2, 2, 1, 1)
    c2w[:, 1, :3, 3] = torch.tensor([0.4, 0.1, -0.1])
    lens = torch.tensor([30.0, 32.0, 20.0, 14.0]).expand(2, 2, 4)
    return Views(torch.rand(2, 2, 3, 32, 40), Cameras(c2w, lens.clone(), (32, 40)))


def _pair(radius_refined: bool, bound: str) -> tuple[QueryGaussianModel, QueryGaussianModel]:
    """LocusGS whose radii differ from anchor to anchor, and its ellipsoidal equal."""
    torch.manual_seed(0)
    locus = compose(_locus(radius_refined, bound))
    with torch.no_grad():
        locus.queries.raw_radius.normal_(-1.0, 1.0)
    ellipsoid = compose(_ellipsoid(radius_refined, bound))
    ellipsoid.load_state_dict(from_locus(locus.state_dict()))
    return locus.eval(), ellipsoid.eval()


def _tensors(layer: LayerPrediction) -> dict[str, Tensor]:
    """Everything that both models have."""
    gaussians = vars(layer.gaussians)
    state = {name: layer.state[name] for name in ("anchor.center",)}
    return {**gaussians, **state, "features": layer.state.features}


@pytest.mark.parametrize("bound", ["floor", "offset"])
@pytest.mark.parametrize("radius_refined", [False, True])
def test_every_tensor_of_every_layer_is_that_of_locusgs(radius_refined: bool, bound: str) -> None:
    locus, ellipsoid = _pair(radius_refined, bound)
    photos = _photos()
    theirs, ours = (model(photos, layers=(1, 2, 3)) for model in (locus, ellipsoid))
    for number in (1, 2, 3):
        expected, seen = theirs.layers[number], ours.layers[number]
        for name, tensor in _tensors(expected).items():
            torch.testing.assert_close(_tensors(seen)[name], tensor, rtol=1e-5, atol=1e-5)
        raw = expected.state["anchor.raw_radius"].expand(-1, -1, 3)
        torch.testing.assert_close(seen.state[RAW_RADII], raw, rtol=1e-5, atol=1e-5)
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 40, 4)
        assert torch.equal(seen.state[ROTATION], identity)
    moved = theirs.state["anchor.center"] - locus.queries(2)["anchor.center"]
    assert moved.abs().max() > 0.01, "the anchors must move for this to say anything"


def test_the_bias_of_every_layer_is_that_of_locusgs() -> None:
    locus, ellipsoid = _pair(radius_refined=True, bound="floor")
    memory = locus.encoder(_photos())
    ours, theirs = ellipsoid.queries(2), locus.queries(2)
    for mine, other in zip(ellipsoid.decoder, locus.decoder, strict=True):
        seen = mine.cross_attention.bias(ours, memory)
        expected = other.cross_attention.bias(theirs, memory)
        torch.testing.assert_close(seen, expected, rtol=1e-5, atol=1e-5)
        assert expected.min() < -1
        ours = ellipsoid.refinements[0](mine(ours, memory))
        theirs = locus.refinements[0](other(theirs, memory))


def test_gradients_of_what_both_have_are_those_of_locusgs() -> None:
    locus, ellipsoid = _pair(radius_refined=True, bound="floor")
    photos = _photos()
    for model in (locus, ellipsoid):
        torch.manual_seed(1)
        means = model(photos).gaussians.means
        (means * torch.randn_like(means)).sum().backward()
    expected = from_locus({n: p.grad for n, p in locus.named_parameters() if p.grad is not None})
    for name, parameter in ellipsoid.named_parameters():
        if name == "queries.raw_radii":
            seen = parameter.grad.sum(-1)
            expected_sum = locus.queries.raw_radius.grad[..., 0]
            torch.testing.assert_close(seen, expected_sum, rtol=1e-3, atol=1e-4)
        elif name.startswith("queries.") and name != "queries.rotation":
            torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4)


def test_weights_without_a_radius_are_refused() -> None:
    queries = AnchoredQueries(AnchoredQueries.Config(count=4, radius=False), ModelDims(32, 2, 1))
    weights = {f"queries.{name}": x for name, x in queries.state_dict().items()}
    with pytest.raises(ValueError, match=r"no `queries.raw_radius`.*`radius: true`"):
        from_locus(weights)
