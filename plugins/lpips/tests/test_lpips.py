"""LPIPS: the published arithmetic, and why it may be unavailable."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from qgs_lpips import Lpips, LpipsLoss
from qgs_plugintools import Case
from qgs_plugintools.inputs import Sizes, inputs_of
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from qgs.composer import RecipeError, resolve
from qgs.contracts import MissingExtraError

CHANNELS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0)
"""VGG-16's convolutions; 0 is a pooling."""


def vgg16(pretrained: bool = False) -> nn.Module:
    """torchvision's VGG-16 without its classifier, random."""
    layers: list[nn.Module] = []
    widths = [3, *filter(None, CHANNELS)]
    for channels in CHANNELS:
        pair = [nn.Conv2d(widths.pop(0), channels, 3, padding=1), nn.ReLU()] if channels else []
        layers += pair or [nn.MaxPool2d(2)]
    model = nn.Module()
    model.features = nn.Sequential(*layers)
    return model


@pytest.fixture
def vgg(tmp_path: Path) -> Path:
    """Random weights of VGG-16."""
    save_file(vgg16().state_dict(), tmp_path / "vgg.safetensors")
    return tmp_path / "vgg.safetensors"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Tensor]:
    """A package that holds weights where `lpips` does, and cannot be imported."""
    folder = tmp_path / "packages" / "lpips"
    (folder / "weights" / "v0.1").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('torchvision does not fit')")
    generator = torch.Generator().manual_seed(1)
    linear = {
        f"lin{n}.model.1.weight": torch.rand(1, width, 1, 1, generator=generator)
        for n, width in enumerate((64, 128, 256, 512, 512))
    }
    torch.save(linear, folder / "weights" / "v0.1" / "vgg.pth")
    monkeypatch.syspath_prepend(folder.parent)
    return linear


def lpips_of(weights: object = None) -> Lpips:
    made = Lpips(Lpips.Config(weights=weights and str(weights)))
    made.load_pretrained()
    return made


def images(*shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


@torch.no_grad()
def by_the_formula(vgg: Path, linear: dict[str, Tensor], image: Tensor, truth: Tensor) -> float:
    """Zhang et al., 2018, equation 1, on relu1_2, relu2_2, relu3_3, relu4_3 and relu5_3."""
    model = vgg16()
    model.load_state_dict(load_file(vgg))
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    total = 0.0
    x, y = (((i * 2 - 1) - shift) / scale for i in (image[None], truth[None]))
    taps = {3: 0, 8: 1, 15: 2, 22: 3, 29: 4}
    for place, layer in enumerate(model.features):
        x, y = layer(x), layer(y)
        if place in taps:
            unit = [f / f.square().sum(1, keepdim=True).sqrt() for f in (x, y)]
            weighted = linear[f"lin{taps[place]}.model.1.weight"] * (unit[0] - unit[1]) ** 2
            total += float(weighted.sum(1).mean())
    return total


@pytest.mark.parametrize("form", ["safetensors", "pth"])
def test_lpips_is_the_published_formula(vgg: Path, package: dict[str, Tensor], form: str) -> None:
    file = vgg.with_suffix(f".{form}")
    if form == "pth":
        torch.save(load_file(vgg), file)
    lpips = lpips_of(file)
    image, truth = images(2, 2, 3, 33, 40)
    values = lpips.distance(image, truth)
    assert values.shape == (2, 2)
    expected = by_the_formula(vgg, package, image[1, 0], truth[1, 0])
    assert float(values[1, 0]) == pytest.approx(expected, rel=1e-5)
    assert torch.equal(lpips.distance(truth, truth), torch.zeros(2, 2))
    assert torch.equal(lpips.distance(image[:1, :1], truth[:1, :1])[0, 0], values[0, 0])
    assert not any(parameter.requires_grad for parameter in lpips.parameters())


def test_lpips_equals_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torchvision, models = ModuleType("torchvision"), ModuleType("torchvision.models")
    torchvision.models, models.vgg16 = models, vgg16
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    lpips = pytest.importorskip("lpips", reason="the extra `weights` is not installed")

    theirs = lpips.LPIPS(net="vgg", pnet_rand=True, verbose=False)
    trunk = {f"features.{k.split('.', 1)[1]}": v for k, v in theirs.net.state_dict().items()}
    save_file({k: v.contiguous() for k, v in trunk.items()}, tmp_path / "vgg.safetensors")
    image, truth = images(2, 3, 48, 37)
    with torch.no_grad():
        expected = theirs(image * 2 - 1, truth * 2 - 1).flatten()
    ours = lpips_of(tmp_path / "vgg.safetensors").distance(image, truth)
    torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.usefixtures("package")
def test_images_are_clipped_and_small_ones_refused(vgg: Path) -> None:
    lpips = lpips_of(vgg).distance
    image, truth = images(1, 3, 16, 16)
    assert torch.equal(lpips(image * 3 - 1, truth), lpips((image * 3 - 1).clamp(0, 1), truth))
    with pytest.raises(ValueError, match="at least 16 pixels a side, got 15x16"):
        lpips(image[..., :15, :], truth[..., :15, :])


def test_without_the_package_the_reason_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("qgs_lpips.network.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="lpips"):
        lpips_of()
    written = {"recipe": 1, "plugins": ["lpips"], "metrics": {"lpips": {"type": "lpips/vgg16"}}}
    metrics = resolve(written).build_metrics()
    assert "lpips" in metrics["lpips"].unavailable  # evaluations go on without it


@pytest.mark.usefixtures("package")
def test_weights_that_are_not_there_or_do_not_fit_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    save_file({"conv1.weight": torch.zeros(1)}, tmp_path / "resnet.safetensors")
    for weights, named in (
        (None, "cache"), ("mine.pth", "mine.pth"), (tmp_path / "resnet.safetensors", "resnet"),
    ):  # fmt: skip
        with pytest.raises(MissingExtraError, match=named):
            lpips_of(weights)


def loss_and_inputs(weights: object) -> tuple[LpipsLoss, dict[str, Any]]:
    case = Case(LpipsLoss.Config(weight=0.5, weights=str(weights)))
    return case.build(), inputs_of(case, Sizes(image=(24, 32)))


@pytest.mark.usefixtures("package")
def test_the_loss_is_the_mean_of_the_metric_and_pulls_towards_the_truth(vgg: Path) -> None:
    loss, given = loss_and_inputs(vgg)
    prediction, rendering, target, inputs = given.values()
    value = loss(prediction, rendering, target, inputs)["vgg16"]
    expected = lpips_of(vgg).distance(rendering.rgb, target.images).mean() / 2
    torch.testing.assert_close(value, expected)
    rgb = rendering.rgb.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(
        loss(prediction, replace(rendering, rgb=rgb), target, inputs)["vgg16"], rgb
    )
    step = rendering.rgb - 0.01 * gradient / gradient.abs().max()
    assert loss(prediction, replace(rendering, rgb=step), target, inputs)["vgg16"] < value
    assert not any(parameter.requires_grad for parameter in loss.parameters())


def test_images_that_are_too_small_are_refused_with_the_recipe() -> None:
    data = {"type": "qgs/photos", "path": "x", "image_size": [8, 16]}
    losses = {"mine": {"type": "lpips/vgg16"}}
    with pytest.raises(RecipeError, match="LPIPS"):
        resolve({"recipe": 1, "plugins": ["lpips"], "losses": losses, "data": data})
