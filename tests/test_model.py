"""The model as a whole, composed from the tiny recipes made smaller still."""

from pathlib import Path

import pytest
import torch
from varying_head import FEATURES, HARMONICS, VaryingHead

import qgs

RECIPES = Path(__file__).parents[1] / "recipes"
SMALL = ["model.width=32", "model.heads=2", "model.queries.count=12"]
TINY = ["tokengs", "locus"]


def small(name: str, *overrides: str) -> qgs.QueryGaussianModel:
    return qgs.compose(RECIPES / f"tiny/{name}.yaml", overrides=[*SMALL, *overrides])


def photos(batch: int = 2, count: int = 2, size: tuple[int, int] = (16, 24)) -> qgs.Views:
    generator = torch.Generator().manual_seed(3)
    c2w = torch.eye(4).repeat(batch, count, 1, 1)
    c2w[..., 0, 3] = 0.2 * torch.arange(count)
    intrinsics = torch.tensor([24.0, 24.0, size[1] / 2, size[0] / 2]).expand(batch, count, 4)
    images = torch.rand(batch, count, 3, *size, generator=generator)
    return qgs.Views(images, qgs.Cameras(c2w, intrinsics, size))


@pytest.mark.parametrize("name", TINY)
def test_the_api_in_five_lines(name: str, tmp_path: Path) -> None:
    model = small(name).eval()
    views = photos()
    prediction = model(views)
    assert prediction.gaussians.means.shape == (2, 12 * 8, 3)
    rendering = model.render(prediction.gaussians, views.cameras)
    assert rendering.rgb.shape == views.images.shape
    qgs.save(model, tmp_path / "model.safetensors")
    again = qgs.load(tmp_path / "model.safetensors").eval()
    assert torch.equal(again(views).gaussians.means, prediction.gaussians.means)


def test_harmonics_and_features_of_a_head_come_through() -> None:
    model, views = small("locus").eval(), photos()
    plain = model(views)
    model.head = VaryingHead(model.head).eval()
    found = model(views)
    assert found.gaussians.sh is not None
    attributes = model.head(found.state)
    assert torch.equal(found.gaussians.sh.unflatten(1, (12, 8)), attributes.sh)
    assert torch.equal(found.gaussians.features.unflatten(1, (12, 8)), attributes.features)
    assert found.gaussians.sh.shape == (2, 12 * 8, HARMONICS, 3)
    assert torch.equal(found.gaussians.colors, plain.gaussians.colors)
    rendering = model.render(found.gaussians, views.cameras)
    assert rendering.features.shape == (2, 2, FEATURES, 16, 24)
    assert not torch.equal(rendering.rgb, model.render(plain.gaussians, views.cameras).rgb)


def test_layers_decoded_while_training_and_evaluating() -> None:
    model = small("locus")
    assert list(model.train()(photos()).layers) == [2, 4]
    assert list(model.eval()(photos()).layers) == [4]
    assert list(model(photos(), layers=[1, 3]).layers) == [1, 3, 4]
    with pytest.raises(ValueError, match=r"layers \[5\] do not exist"):
        model(photos(), layers=[5])


def test_refinement_is_shared_by_all_layers() -> None:
    assert len(small("locus").refinements) == 1
    override = "model.decoder.layers.0.refinement={type: locus/refine, radius: false}"
    assert len(small("locus", override).refinements) == 2


@pytest.mark.parametrize("name", TINY)
def test_scenes_of_a_batch_are_independent(name: str) -> None:
    model, views = small(name).eval(), photos()
    first = qgs.Views(views.images[:1], views.cameras[:1])
    both, alone = model(views).gaussians.means[:1], model(first).gaussians.means
    torch.testing.assert_close(both, alone, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", TINY)
def test_permuting_queries_permutes_gaussians(name: str) -> None:
    model, views = small(name).eval(), photos()
    before = model(views).gaussians.means.unflatten(1, (12, 8))
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for parameter in model.queries.parameters():
            parameter.copy_(parameter[order])
    after = model(views).gaussians.means.unflatten(1, (12, 8))
    torch.testing.assert_close(after, before[:, order], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", TINY)
def test_geometry_is_float32_under_autocast(name: str) -> None:
    model = small(name).eval()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = model(photos())
    tensors = [prediction.gaussians.means, prediction.gaussians.scales, prediction.gaussians.quats]
    tensors += list(prediction.state.fields.values())
    assert {tensor.dtype for tensor in tensors} == {torch.float32}


@pytest.mark.parametrize("name", TINY)
def test_every_parameter_learns(name: str) -> None:
    model, views = small(name).train(), photos()
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    # Two steps: heads that start at zero pass gradients on from the second one.
    for _ in range(2):
        optimizer.zero_grad()
        prediction = model(views)
        loss = sum(
            (model.render(layer.gaussians, views.cameras).rgb - views.images).square().mean()
            + layer.gaussians.means.square().mean()
            for layer in prediction.layers.values()
        )
        loss.backward()
        optimizer.step()
    dead = [
        name
        for name, parameter in model.named_parameters()
        if parameter.grad is None or not parameter.grad.abs().sum() > 0
    ]
    # Softmax ignores what is added to all keys alike; k_norm's bias is that.
    assert [name for name in dead if not name.endswith("k_norm.bias")] == []
