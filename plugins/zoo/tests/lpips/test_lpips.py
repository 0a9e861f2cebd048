"""LPIPS: the published arithmetic, and why it may be unavailable."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from qgs_zoo.lpips import Lpips, LpipsLoss
from safetensors.torch import load_file, save_file
from tables import assert_equal, assert_near, must_refuse
from torch import nn
from torch.testing import assert_close

from qgs.contracts import MissingExtraError
from qgs.recipe import resolve

CHANNELS = "64 64 0 128 128 0 256 256 256 0 512 512 512 0 512 512 512 0"
"""VGG-16's convolutions; 0 is a pooling."""
RECIPE = {"recipe": 1, "plugins": ["lpips"]}
PART = 4
"""Tests take this part of them, for time."""


def vgg16():
    """torchvision's VGG-16 without its classifier, random and narrow."""
    layers = []
    before = 3
    for channels in map(int, CHANNELS.split()):
        if channels:
            layers += [nn.Conv2d(before, channels // PART, 3, padding=1), nn.ReLU()]
            before = channels // PART
        else:
            layers.append(nn.MaxPool2d(2))
    return nn.ModuleDict({"features": nn.Sequential(*layers)})


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package that holds weights where `lpips` does, and cannot be imported."""
    folder = tmp_path / "packages/lpips"
    (folder / "weights/v0.1").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('torchvision does not fit')")
    linear = [torch.rand(1, width // PART, 1, 1) for width in (64, 128, 256, 512, 512)]
    named = {f"lin{n}.model.1.weight": x for n, x in enumerate(linear)}
    torch.save(named, folder / "weights/v0.1/vgg.pth")
    monkeypatch.syspath_prepend(folder.parent)
    return linear


@pytest.fixture
def vgg(tmp_path, package):
    """Random weights of VGG-16, so large that its last layers tell images apart."""
    weights = {name: 2.5 * x for name, x in vgg16().state_dict().items()}
    save_file(weights, tmp_path / "vgg.safetensors")
    return tmp_path / "vgg.safetensors"


def lpips_of(weights=None):
    made = Lpips(Lpips.Config(weights=weights and str(weights)))
    made.load_pretrained()
    return made


@torch.no_grad()
def by_the_formula(vgg, linear, both):
    """Zhang et al., 2018, equation 1, on relu1_2, relu2_2, relu3_3, relu4_3 and relu5_3."""
    model = vgg16()
    model.load_state_dict(load_file(vgg))
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    total = 0.0
    x = (both * 2 - 1 - shift) / scale
    taps = dict(zip((3, 8, 15, 22, 29), linear, strict=True))
    for place, layer in enumerate(model["features"]):
        x = layer(x)
        if place in taps:
            image, truth = x / x.norm(dim=1, keepdim=True)
            total += float((taps[place][0] * (image - truth) ** 2).sum(0).mean())
    return total


def test_lpips_is_the_published_formula(vgg, package):
    image, truth = both = torch.rand(2, 2, 2, 3, 33, 40)
    expected = by_the_formula(vgg, package, both[:, 1, 0])
    lpips = lpips_of(vgg)
    values = lpips.distance(image, truth)
    assert_near(values[1, 0], expected, rtol=1e-5)
    assert_equal(lpips.distance(truth, truth), torch.zeros(2, 2))
    assert_equal(lpips.distance(image[0, :1], truth[0, :1]), values[0, :1])
    assert not any(parameter.requires_grad for parameter in lpips.parameters())


def test_images_are_clipped_and_small_ones_refused(vgg):
    lpips = lpips_of(vgg).distance
    image, truth = torch.rand(2, 1, 3, 16, 16)
    assert_equal(lpips(image * 3 - 1, truth), lpips((image * 3 - 1).clamp(0, 1), truth))
    must_refuse(
        "at least 16 pixels a side, got 15x16", lpips, image[..., :15, :], truth[..., :15, :]
    )


def test_without_the_package_the_reason_names_the_extra(monkeypatch):
    monkeypatch.setattr("qgs_zoo.lpips.network.find_spec", lambda name: None)
    must_refuse("lpips", lpips_of, kind=MissingExtraError)
    metrics = resolve(RECIPE, ["metrics={lpips: {type: lpips/vgg16}}"]).build_metrics()
    assert "lpips" in metrics["lpips"].unavailable  # evaluations go on without it


def test_weights_that_are_not_there_or_do_not_fit_are_named(tmp_path, monkeypatch, package):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    resnet = tmp_path / "resnet.safetensors"
    save_file({"conv1.weight": torch.zeros(1)}, resnet)
    for weights, named in ((None, "vgg16-397"), (Path("mine.pth"), "mine.pth"), (resnet, "resnet")):
        must_refuse(named, lpips_of, weights, kind=MissingExtraError)


def test_the_loss_is_the_mean_of_the_metric_and_pulls_towards_the_truth(vgg):
    loss = LpipsLoss(LpipsLoss.Config(weights=str(vgg)))
    loss.load_pretrained()
    rgb, truth = torch.rand(2, 2, 2, 3, 24, 32)

    def value(rgb):
        return loss(None, SimpleNamespace(rgb=rgb), SimpleNamespace(images=truth), None)["vgg16"]

    found = value(rgb.requires_grad_())
    assert_close(found, lpips_of(vgg).distance(rgb, truth).mean() / 2)
    (gradient,) = torch.autograd.grad(found, rgb)
    assert value(rgb - 0.01 * gradient / gradient.abs().max()) < found
    assert not any(parameter.requires_grad for parameter in loss.parameters())
