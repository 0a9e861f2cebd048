"""DINOv2's transformer: names, sizes, weights of files; plugins/zoo tests its numbers."""

import torch
from qgs_zoo.dinov2 import DinoMultiViewViT
from qgs_zoo.dinov2.vit import GRID, DinoV2, VitConfig
from safetensors.torch import save_file
from small_parts import Code, made
from tables import assert_equal, must_refuse

from qgs.contracts import MissingExtraError, ModelDims


def test_positions_of_the_trained_size_stay():
    vit = DinoV2(8, 0, 2)
    assert vit.positions(GRID, GRID) is vit.pos_embed


def test_weights_of_a_file_are_loaded(tmp_path):
    """Under the hub's names or behind a prefix, whatever else the file holds. The same function
    reads the files of VGGT and LPIPS."""
    small = dict(DinoV2(8, 2, 2).named_parameters())
    dims = ModelDims(width=8, heads=2, depth=1)
    for prefix, suffix in (("", ".pth"), ("pretrained.", ".pt"), ("pretrained.", ".safetensors")):
        published = {prefix + name: torch.randn_like(x) for name, x in small.items()}
        others = {"depth_head.weight": torch.ones(1), prefix + "mask_token": torch.ones(1, 8)}
        file = tmp_path / f"vit{suffix}"
        (save_file if suffix == ".safetensors" else torch.save)(published | others, file)
        vit = VitConfig(width=8, depth=2, heads=2, weights=str(file))
        encoder = made(DinoMultiViewViT, dims, patch_size=4, vit=vit)
        encoder.load_pretrained()
        assert_equal(encoder.rgb_embedding.vit.state_dict(prefix=prefix), published)


def test_other_files_are_refused(tmp_path):
    vit = DinoV2(8, 2, 2)
    for name, content in {
        "absent.pth": None,
        "other_names.pth": {"weight": torch.ones(2)},
        "other_sizes.pth": DinoV2(16, 2, 2).state_dict(),
        "too_few.pth": dict([*vit.state_dict().items()][:5]),
        "code.pth": {"model": Code()},
    }.items():
        if content:
            torch.save(content, tmp_path / name)
        must_refuse(name, vit.load, str(tmp_path / name), kind=MissingExtraError)
