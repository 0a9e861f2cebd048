"""With three equal radii and a shape that does not turn it is LocusGS, in every tensor."""

from typing import Any

import pytest
import torch
from qgs_ellipsoid.conversion import from_locus
from qgs_ellipsoid.fields import RAW_RADII, ROTATION
from qgs_locus.anchors import AnchoredQueries
from torch import Tensor

from qgs import Cameras, QueryGaussianModel, Views, compose
from qgs.contracts import ModelDims
from qgs.types import LayerPrediction, named_tensors


def _recipe(
    plugin: str, radius_refined: bool = True, bound: str = "floor", **refinement: Any
) -> dict[str, Any]:
    """A model of LocusGS or of ellipsoids. refinement: other options of it."""
    radius = {"radius_bound": bound}
    if not refinement:
        refinement = {"radius": radius_refined, **(radius if radius_refined else {})}
        refinement |= {"rotation": False} if plugin == "ellipsoid" else {}
    centers = {"locus": "locus/radius_scaled", "ellipsoid": "ellipsoid/axis_scaled"}[plugin]
    model = {
        "width": 48,
        "heads": 3,
        "encoder": {"depth": 1},
        "queries": {"type": f"{plugin}/anchored", "count": 40, "std": 0.5, **radius},
        "decoder": {
            "depth": 3,
            "layer_scale": 0.5,
            "cross_attention": {"type": f"{plugin}/ray_biased", "gamma_init": 0.5, **radius},
            "self_attention": {"type": "locus/anchor_aware"},
            "refinement": {"type": f"{plugin}/refine", **refinement},
        },
        "head": {"gaussians_per_query": 4, "init_std": 0.1},
        "centers": {"type": centers, **radius},
        "supervision": {"layers": [1, 2, 3]},
        "renderer": {"type": "qgs/torch"},
    }
    return {"recipe": 1, "plugins": ["locus", "ellipsoid"], "model": model}


def _photos() -> Views:
    c2w = torch.eye(4).repeat(2, 2, 1, 1)
    c2w[:, 1, :3, 3] = torch.tensor([0.4, 0.1, -0.1])
    lens = torch.tensor([30.0, 32.0, 20.0, 14.0]).expand(2, 2, 4)
    return Views(torch.rand(2, 2, 3, 32, 40), Cameras(c2w, lens.clone(), (32, 40)))


def _pair(
    radius_refined: bool = True, bound: str = "floor"
) -> tuple[QueryGaussianModel, QueryGaussianModel]:
    """LocusGS whose radii differ from anchor to anchor, and its ellipsoidal equal."""
    torch.manual_seed(0)
    locus = compose(_recipe("locus", radius_refined, bound))
    with torch.no_grad():
        locus.queries.raw_radius.normal_(-1.0, 1.0)
    ellipsoid = compose(_recipe("ellipsoid", radius_refined, bound))
    ellipsoid.load_state_dict(from_locus(locus.state_dict()))
    return locus.eval(), ellipsoid.eval()


def _tensors(layer: LayerPrediction) -> dict[str, Tensor]:
    """Everything that both models have."""
    state = {"anchor.center": layer.state["anchor.center"], "features": layer.state.features}
    return {**dict(named_tensors(layer.gaussians)), **state}


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
    moved = theirs.state["anchor.center"] - locus.queries.start(2)["anchor.center"]
    assert moved.abs().max() > 0.01, "the anchors must move for this to say anything"


def test_the_bias_of_every_layer_is_that_of_locusgs() -> None:
    locus, ellipsoid = _pair()
    memory = locus.encoder(_photos())
    ours, theirs = ellipsoid.queries.start(2), locus.queries.start(2)
    for mine, other in zip(ellipsoid.decoder, locus.decoder, strict=True):
        seen = mine.cross_attention.bias(ours, memory).dense()
        expected = other.cross_attention.bias(theirs, memory).dense()
        torch.testing.assert_close(seen, expected, rtol=1e-5, atol=1e-5)
        assert expected.min() < -1
        ours = ellipsoid.refinements[0](mine(ours, memory)[0])
        theirs = locus.refinements[0](other(theirs, memory)[0])


def _like_locus(gradients: dict[str, Tensor]) -> dict[str, Tensor]:
    """Gradients of three radii that are one, summed as those of the one."""
    alike = {}
    for name, gradient in gradients.items():
        if name.startswith("refinements.0.radius_mlp.fc2."):
            gradient = gradient.sum(0, keepdim=True)
        if name == "queries.raw_radii":
            name, gradient = "queries.raw_radius", gradient.sum(-1, keepdim=True)
        alike[name] = gradient
    return alike


def test_every_gradient_is_that_of_locusgs() -> None:
    seen = []
    for model in (model.double() for model in _pair()):
        torch.manual_seed(1)
        gaussians = model(_photos().to(torch.float64)).gaussians
        loss = sum((x * torch.randn_like(x)).sum() for _, x in named_tensors(gaussians))
        loss.backward()
        seen.append({n: p.grad for n, p in model.named_parameters() if p.grad is not None})
    expected, ours = seen[0], _like_locus(seen[1])
    assert ours.keys() - expected.keys() == {"queries.rotation"}
    assert len(expected) > 100
    for name, gradient in expected.items():
        torch.testing.assert_close(ours[name], gradient, rtol=1e-6, atol=1e-8, msg=name)


def test_it_is_locusgs_in_half_precision_too() -> None:
    locus, ellipsoid = _pair()
    photos = _photos()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        theirs, ours = (model(photos).gaussians for model in (locus, ellipsoid))
    for name, tensor in named_tensors(theirs):
        torch.testing.assert_close(getattr(ours, name), tensor, rtol=1e-5, atol=1e-5)


def test_a_trained_locusgs_is_where_a_model_that_turns_can_start() -> None:
    locus, _ = _pair()
    turning = compose(_recipe("ellipsoid", zero_init=True))
    absent = turning.load_state_dict(from_locus(locus.state_dict()), strict=False)
    assert {name.rpartition(".fc")[0] for name in absent.missing_keys} == {
        "refinements.0.rotation_mlp"
    }
    assert absent.unexpected_keys == []
    photos = _photos()
    theirs, ours = (model.eval()(photos).gaussians for model in (locus, turning))
    torch.testing.assert_close(ours.means, theirs.means, rtol=1e-5, atol=1e-5)


def test_weights_without_a_radius_are_refused() -> None:
    queries = AnchoredQueries(AnchoredQueries.Config(count=4, radius=False), ModelDims(32, 2, 1))
    weights = {f"queries.{name}": x for name, x in queries.state_dict().items()}
    with pytest.raises(ValueError, match=r"no `queries.raw_radius`.*`radius: true`"):
        from_locus(weights)
