"""DINOv2's transformer: names, positions, weights of files; plugins/mvsplat tests its numbers."""

from pathlib import Path

import pytest
import torch
from qgs_dinov2 import DinoMultiViewViT
from qgs_dinov2.vit import GRID, DinoV2, VitConfig
from qgs_dinov2.weight_file import load_weights
from safetensors.torch import save_file
from torch import Tensor

from qgs.contracts import MissingExtraError, ModelDims

SIZES = {"S": (384, 12, 6), "B": (768, 12, 12), "L": (1024, 24, 16)}
PUBLISHED = {"S": 22_056_192, "B": 86_579_712, "L": 304_367_616}
"""Parameters of the release, less its mask token."""


def small() -> DinoV2:
    torch.manual_seed(0)
    return DinoV2(8, 2, 2)


@pytest.mark.parametrize("size", SIZES)
def test_parameters_are_as_many_as_published(size: str) -> None:
    width, depth, _ = SIZES[size]
    block = 12 * width**2 + 15 * width  # qkv 3, proj 1, MLP 8; biases 9, norms 4, LayerScale 2
    embedding = 3 * 14**2 * width + width + width + (1 + GRID**2) * width
    with torch.device("meta"):
        vit = DinoV2(*SIZES[size])
    count = sum(x.numel() for x in vit.parameters())
    assert count == depth * block + embedding + 2 * width == PUBLISHED[size]


def test_positions_of_the_trained_size_stay_and_others_step_by_the_releases_factor() -> None:
    vit = small()
    assert vit.positions(GRID, GRID) is vit.pos_embed
    ramp = torch.linspace(0, 1, GRID, dtype=torch.float64).float()
    with torch.no_grad():
        vit.pos_embed[0, 1:] = ramp.repeat(GRID)[:, None]  # rises along the columns
    found = vit.positions(9, 18)[0, 1:, 0].view(9, 18)
    # Bicubic interpolation repeats a ramp up to 0.002; source coordinates step by 37 / 18.1, and
    # steps of 37 / 18 would be off by 0.005 at the right.
    expected = ((torch.arange(18) + 0.5) * GRID / 18.1 - 0.5) / (GRID - 1)
    torch.testing.assert_close(found[:, 2:-2], expected[2:-2].expand(9, -1), atol=2e-3, rtol=0)


def test_tokens_of_blocks_pass_the_last_norm_and_leave_the_class_token_out() -> None:
    vit, images = small(), torch.randn(2, 3, 28, 42)
    first, last = vit(images, (0, 1))
    assert first.shape == last.shape == (2, 6, 8)
    torch.testing.assert_close(first, vit(images, (0,))[0])
    torch.testing.assert_close(last.mean(-1), torch.zeros(2, 6), atol=1e-5, rtol=0)


@pytest.mark.parametrize("prefix", ["", "pretrained."])
@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_weights_of_a_file_are_loaded(tmp_path: Path, prefix: str, suffix: str) -> None:
    published = {prefix + name: x.detach().clone() for name, x in small().named_parameters()}
    published |= {"depth_head.weight": torch.ones(1), prefix + "mask_token": torch.ones(1, 8)}
    file = tmp_path / f"vit{suffix}"
    save_file(published, file) if suffix == ".safetensors" else torch.save(published, file)
    config = DinoMultiViewViT.Config(
        patch_size=4, vit=VitConfig(width=8, depth=2, heads=2, weights=str(file))
    )
    encoder = DinoMultiViewViT(config, ModelDims(width=8, heads=2, depth=1))
    encoder.load_pretrained()
    for name, parameter in encoder.rgb_embedding.vit.named_parameters():
        assert torch.equal(parameter, published[prefix + name])


class Evil:
    def __reduce__(self) -> tuple:
        return print, ("ran",)


def _nothing(file: Path) -> None:
    """Leave the file away."""


def _other_names(file: Path) -> None:
    torch.save({"weight": torch.ones(2)}, file)


def _other_sizes(file: Path) -> None:
    torch.save(DinoV2(16, 2, 2).state_dict(), file)


def _too_few(file: Path) -> None:
    torch.save(dict(list(small().state_dict().items())[:5]), file)


def _code(file: Path) -> None:
    torch.save({"model": Evil()}, file)


@pytest.mark.parametrize("write", [_nothing, _other_names, _other_sizes, _too_few, _code])
def test_other_files_are_refused(tmp_path: Path, write, capsys) -> None:
    file = tmp_path / "vit.pth"
    write(file)
    vit = small()
    before: dict[str, Tensor] = {name: x.clone() for name, x in vit.state_dict().items()}
    with pytest.raises(MissingExtraError, match=r"vit\.pth"):
        load_weights(vit, str(file))
    assert "ran" not in capsys.readouterr().out
    assert vit.state_dict().keys() == before.keys()


def test_a_file_of_another_kind_is_refused() -> None:
    with pytest.raises(MissingExtraError, match="safetensors"):
        load_weights(small(), "vit.npz")
