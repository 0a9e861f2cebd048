"""VGGT's features, with a stand-in for VGGT that has its interface and a few weights."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import qgs_c3g.vggt
import torch
from qgs_c3g.vggt import MODULE, VggtFeatures
from qgs_plugintools import Case, checks_for, run_check
from refusals import refused
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

import qgs
from qgs.composer import resolve
from qgs.contracts import MissingExtraError, ModelDims
from qgs.types import Cameras, Views

C = 8
"""Width of the stand-in's tokens in place of 2048."""

DIMS = ModelDims(width=16, heads=2, depth=1)


SEEN: list[tuple[float, float]] = []
"""Least and largest number of the images that the stand-in was given."""


class Aggregator(nn.Module):
    """As VGGT's: all layers' tokens (B, V, 5 + P, C), the first five of no patch."""

    def __init__(self) -> None:
        super().__init__()
        self.decay = [x.item() for x in torch.linspace(0, 1, 3)]  # VGGT's constructor does
        self.patch = nn.Conv2d(3, C, 14, 14)
        self.first = nn.Parameter(torch.randn(2, C))

    def forward(self, images: Tensor) -> tuple[list[Tensor], int]:
        if images.device.type != "meta":
            SEEN.append((images.min().item(), images.max().item()))
        tokens = self.patch(images.flatten(0, 1)).flatten(2).mT.unflatten(0, images.shape[:2])
        order = torch.arange(images.shape[1], device=images.device).clamp_max(1)
        tokens = torch.tanh(tokens) + self.first[order][:, None]
        tokens = tokens + tokens.mean((1, 2), keepdim=True)
        special = torch.full_like(tokens[:, :, :1], 7.0).expand(-1, -1, 5, -1)
        return [torch.zeros(()), torch.cat([special, tokens], 2)], 5


@pytest.fixture(autouse=True)
def vggt(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType(MODULE)
    module.Aggregator = Aggregator
    for package in ("vggt", "vggt.models"):
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
    monkeypatch.setitem(sys.modules, MODULE, module)
    monkeypatch.setattr(qgs_c3g.vggt, "WIDTH", C)


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of all of VGGT's weights, which has more than the aggregator's."""
    torch.manual_seed(3)
    file = tmp_path_factory.mktemp("vggt") / "model.safetensors"
    own = {f"aggregator.{name}": x for name, x in Aggregator().state_dict().items()}
    save_file({**own, "camera_head.weight": torch.zeros(2)}, file)
    return file


def encoder(weights: str | Path, width: int = C, **options: Any) -> VggtFeatures:
    config = VggtFeatures.Config(weights=str(weights), **options)
    made = VggtFeatures(config, replace(DIMS, width=width))
    made.load_pretrained()
    return made


def views(height: int = 28) -> Views:
    c2w = torch.eye(4).repeat(2, 3, 1, 1)
    lens = torch.tensor([20.0, 20.0, 21.0, 14.0]).expand(2, 3, 4)
    return Views(torch.rand(2, 3, 3, height, 42), Cameras(c2w, lens, (height, 42)))


def test_it_gives_the_patch_tokens_of_the_last_layer(weights: Path) -> None:
    made, given = encoder(weights), views()
    memory = made(given)
    expected = made.aggregator(given.images * 2 - 1)[0][-1][:, :, 5:]
    assert memory.features.shape == (2, 3 * 2 * 3, C)
    assert torch.equal(memory.features, expected.flatten(1, 2))
    assert memory.grid == (3, 2, 3)
    assert memory.keys is memory.values is memory.patch_rays is None
    blind = Views(given.images, replace(given.cameras, c2w=given.cameras.c2w + 1))
    assert torch.equal(made(blind).features, memory.features)


@pytest.mark.parametrize(("images", "least"), [("signed", -1.0), ("unit", 0.0)])
def test_images_are_given_as_told(weights: Path, images: str, least: float) -> None:
    made = encoder(weights, images=images)
    SEEN.clear()
    made(views())
    ((low, high),) = SEEN
    assert (low, high) == pytest.approx((least, 1.0), abs=0.01)


def test_a_model_of_another_width_has_a_linear_layer(weights: Path) -> None:
    narrow = encoder(weights, width=6)
    assert narrow(views()).features.shape[-1] == 6
    assert narrow.proj.weight.shape == (6, C)
    assert not [name for name, _ in encoder(weights).named_parameters() if "proj" in name]


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_weights_are_the_users(weights: Path, tmp_path: Path, suffix: str) -> None:
    file = weights
    if suffix == ".pt":
        file = tmp_path / "model.pt"
        torch.save(load_file(weights), file)
    for name, own in encoder(file).aggregator.state_dict().items():
        assert torch.equal(own, load_file(weights)[f"aggregator.{name}"])


def test_code_in_a_file_of_weights_is_not_run(tmp_path: Path) -> None:
    file = tmp_path / "model.pt"
    torch.save({"aggregator.first": Aggregator()}, file)
    with pytest.raises(MissingExtraError, match=r"model\.pt does not hold"):
        encoder(file)


@pytest.mark.parametrize("name", ["absent.safetensors", "my.ckpt", "other.safetensors", "cut.pt"])
def test_weights_that_cannot_be_read_are_named(tmp_path: Path, name: str) -> None:
    save_file({"aggregator.first": torch.zeros(2, C)}, tmp_path / "other.safetensors")
    (tmp_path / "cut.pt").write_bytes(b"no weights")
    with pytest.raises(MissingExtraError, match=name):
        encoder(tmp_path / name)


def test_without_vggt_the_message_names_what_installs_it(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, MODULE, None)
    recipe = resolve(written(weights))
    for device in ("cpu", "meta"):
        with pytest.raises(MissingExtraError, match=r"pip install git\+https.*qgs/multiview_vit"):
            recipe.build_model(device)


def written(weights: Path) -> dict[str, Any]:
    """The recipe of the README, small."""
    return {
        "recipe": 1,
        "plugins": ["c3g"],
        "model": {
            "width": C,
            "heads": 2,
            "encoder": {"type": "c3g/vggt_features", "weights": str(weights)},
            "queries": {"count": 6},
            "decoder": {"depth": 1, "layer": {"type": "c3g/joint"}},
            "head": {"type": "c3g/head"},
            "centers": {"type": "qgs/offset"},
            "supervision": {"layers": [1]},
            "renderer": {"type": "qgs/torch"},
        },
        "optimizer": {"parts": {"encoder": 0.01, "queries": 0.01}},
    }


def test_a_checkpoint_needs_no_file_of_weights(weights: Path, tmp_path: Path) -> None:
    own = tmp_path / "model.safetensors"
    own.write_bytes(weights.read_bytes())
    model, given = resolve(written(own)).build_model().eval(), views()
    qgs.save(model, tmp_path / "checkpoint.safetensors")
    own.unlink()
    loaded = qgs.load(tmp_path / "checkpoint.safetensors")
    assert torch.equal(loaded(given).gaussians.means, model(given).gaussians.means)
    with pytest.raises(MissingExtraError, match="there are no weights"):
        resolve(written(own)).build_model()


def test_images_must_consist_of_patches(weights: Path) -> None:
    with pytest.raises(ValueError, match="27 x 42"):
        encoder(weights)(views(height=27))
    data = {"type": "rooms/procedural", "image_size": [256, 224]}
    problem = refused({**written(weights), "plugins": ["c3g", "rooms"], "data": data})
    assert "patches of 14 do not divide images of 256 x 224" in problem.reason
    assert "[252, 224]" in problem.fix


def test_what_needs_rays_or_keys_is_refused_with_it(weights: Path) -> None:
    recipe = written(weights)
    recipe["model"]["decoder"] = {"depth": 1}
    problem = refused(recipe)
    assert "`qgs/content` needs memory.keys" in problem.reason


@pytest.mark.parametrize("images", ["signed", "unit"])
def test_it_keeps_the_contract_of_encoders(weights: Path, images: str) -> None:
    case = Case(VggtFeatures.Config(weights=str(weights), images=images))
    results = [run_check(check, case) for check in checks_for(case, ("core",))]
    assert [(r.check.name, r.message) for r in results if not r.ok] == []
    assert sum(r.verdict == "passed" for r in results) > 20
