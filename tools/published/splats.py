"""What golden files of MVSplat and DepthSplat share: views, weights, a recorder of modules."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from qgs_zoo.mvsplat.adapter import band_mask, camera_quaternions, turn_of_harmonics
from qgs_zoo.mvsplat.pixels import PixelQueries
from qgs_zoo.mvsplat.windows import out_of_windows
from torch import Tensor, nn

from published.files import GoldenFile, GoldenFileError
from published.seeded_weights import seeded_state_dict, weights_check
from qgs.contracts import ModelDims
from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Cameras, ImageMemory, QueryState, Views


def views_of(golden: GoldenFile) -> Views:
    """Photos and cameras; lenses of the files are divided by the image's size."""
    images = golden.input("images")
    size = (images.shape[-2], images.shape[-1])
    lens = lens_of(golden.input("intrinsics"), size)
    return Views(images, Cameras(golden.input("extrinsics"), lens, size))


def lens_of(k: Tensor, size: tuple[int, int] = (1, 1)) -> Tensor:
    """fx, fy, cx, cy (..., 4) in pixels of matrices that are divided by `size`, (H, W)."""
    lens = torch.stack([k[..., 0, 0], k[..., 1, 1], k[..., 0, 2], k[..., 1, 2]], -1)
    return lens * lens.new_tensor([size[1], size[0], size[1], size[0]])


def weights_of(golden: GoldenFile) -> dict[str, Tensor]:
    """The state dict under its published names, without the prefix of checkpoints.

    Raises GoldenFileError where the file was made with other weights.
    """
    rule = golden.config["weights"]
    arrays = seeded_state_dict(golden.config["state_dict"], rule["seed"], rule["factors"])
    if not np.allclose(weights_check(arrays), golden.tensors["weights_check"].numpy()):
        raise GoldenFileError("the file was not made with the weights of its metadata")
    golden.read.add("weights_check")
    return {name: torch.from_numpy(x) for name, x in arrays.items()}


def gaussians(views: Views, numbers: Tensor, head: Any, centers: Any) -> dict[str, Tensor]:
    """Return outputs behind the networks, by queries, head and centers.

    numbers: (B, V, H, W, C), what the networks give for each pixel.
    """
    cameras = views.cameras
    count = cameras.shape[1]
    state = pixel_state(views, numbers)
    out = head(state)
    factors = quat_to_matrix(out.quats) * out.scales[..., None, :]
    sh = numbers[..., 11:].unflatten(-1, (3, -1))
    degree = round(sh.shape[-1] ** 0.5) - 1
    turn = turn_of_harmonics(cameras.c2w[..., :3, :3], degree) * band_mask(degree, cameras.c2w)
    row, column = torch.meshgrid(*(torch.arange(side) for side in cameras.size), indexing="ij")
    place = torch.stack([column, row], -1) + numbers[..., 2:4].sigmoid()
    return {
        "ray_xy": place / torch.tensor([cameras.size[1], cameras.size[0]]),
        "means": centers(out.offsets, state)[:, :, 0],
        "covariances": (factors @ factors.mT)[:, :, 0],
        "opacities": out.opacities[..., 0],
        "scales": out.scales.unflatten(1, (count, *cameras.size)),
        "rotations": camera_quaternions(numbers[..., 7:11]),
        "harmonics": torch.einsum("bvkl,bvhwxl->bvhwxk", turn, sh).flatten(1, 3),
    }


def pixel_state(views: Views, numbers: Tensor) -> QueryState:
    """Return a query for each pixel, with its numbers (B, V, H, W, C)."""
    memory = ImageMemory(numbers.flatten(1, 3), grid=(views.cameras.shape[1], *views.cameras.size))
    dims = ModelDims(numbers.shape[-1], 1, 0)
    return PixelQueries(PixelQueries.Config(), dims)(memory, views)


class Recorder:
    """Outputs of modules by name, (B, V, ...)."""

    def __init__(self, views: int) -> None:
        self.views = views
        self.found: dict[str, Tensor] = {}

    def keep(self, name: str, x: Tensor) -> None:
        """A tensor with scenes and views in one axis."""
        self.found[name] = x.detach().unflatten(0, (-1, self.views))

    def output(self, name: str, module: nn.Module) -> None:
        """What a module returns."""

        def keep(_: Any, __: Any, out: Tensor) -> None:
            self.keep(name, out)

        module.register_forward_hook(keep)

    def input(self, name: str, module: nn.Module, channels: slice = slice(None)) -> None:
        """What a module is given."""
        module.register_forward_pre_hook(lambda _, given: self.keep(name, given[0][:, channels]))

    def table(self, root: nn.Module, text: str) -> None:
        """Keep outputs of modules: a name and the path of a module below `root` a line."""
        for line in text.strip().splitlines():
            name, path = line.split()
            self.output(name, root.get_submodule(path))

    def transformer(self, transformer: Any, size: Sequence[int], last: str) -> None:
        """The stream before and behind each attention in windows; `last` names the result."""
        found = self.found
        transformer.register_forward_pre_hook(
            lambda _, given: found.update({"transformer.0": given[0]})
        )
        for index, layer in enumerate(transformer.layers):
            self._windows(f"transformer_self.{index}", layer.self_attn, size, bool(index % 2))
            self._windows(f"transformer.{index + 1}", layer, size, bool(index % 2))
        transformer.register_forward_hook(lambda _, __, out: found.update({last: out}))

    def _windows(self, name: str, module: nn.Module, size: Sequence[int], shifted: bool) -> None:
        shift = (size[0] // 4, size[1] // 4) if shifted else (0, 0)

        def keep(_: Any, __: Any, out: Tensor) -> None:
            whole = out_of_windows(out, (size[0], size[1]), shift)
            self.found[name] = whole.permute(0, 1, 4, 2, 3)

        module.register_forward_hook(keep)

    def unet(self, name: str, unet: Any) -> None:
        """Blocks, and each attention with what it has before its projection."""
        for place, block in _blocks(unet):
            self.output(f"{name}.{place}", block)
            if hasattr(block, "qkv"):
                self.input(f"{name}.{place}.attention", block.proj_out)
        self.output(f"{name}.out", unet.out)


def _blocks(unet: Any) -> Iterator[tuple[str, Any]]:
    for part in ("input_blocks", "middle_block", "output_blocks"):
        for index, block in enumerate(getattr(unet, part)):
            yield f"{part}.{index}", block
            inside = list(block) if part != "middle_block" else []
            if len(inside) > 1 and hasattr(inside[1], "qkv"):
                yield f"{part}.{index}.1", inside[1]
