"""Models of golden files, shared parts of those of MVSplat and DepthSplat, files of single cases.

A recorder keeps inputs and outputs of modules inside a model.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from qgs_research.published.layouts import fitting_recipe, names_of
from qgs_zoo.mvsplat.adapter import band_mask, camera_quaternions, coefficients, turn_of_harmonics
from qgs_zoo.mvsplat.pixels import PIXEL, degree_of, mapped_opacity, ray_directions
from qgs_zoo.mvsplat.sweep import warp_grid, warped
from qgs_zoo.mvsplat.windows import out_of_windows
from qgs_zoo.parts import feature_lenses
from torch import Tensor, nn

import qgs
from published.files import GoldenFile, Tensors
from published.seeded_weights import seeded_weight
from qgs.checkpoint.tensors import shapes_of
from qgs.geometry.harmonics import SH_C0
from qgs.geometry.transforms import quat_to_matrix
from qgs.model import QueryGaussianModel
from qgs.recipe import resolve
from qgs.types import Cameras, ImageMemory, Prediction, Views

Change = Callable[[Tensor], Tensor]

UNDECIDED = {
    "gaussian_center_variant": {
        "anchor_offset": "model.centers.type=locus/anchor_offset",
        "free_center": "model.centers={type: qgs/free, z_offset: 0.0}",
    },
    "anchor_radius_affects_bias": {False: "model.decoder.cross_attention.bandwidth=fixed"},
}
"""Overrides for values of published options that the shapes of weights do not determine."""


class Recorder:
    """Recorder of inputs and outputs of modules, by name.

    shaped: function that changes each tensor before it is kept.
    """

    def __init__(self, shaped: Change = Tensor.detach) -> None:
        self.shaped = shaped
        self.found: Tensors = {}

    def output(self, name: str, module: nn.Module, shaped: Change | None = None) -> None:
        """Record the outputs of a module as `name`."""
        change = shaped or self.shaped
        module.register_forward_hook(lambda _, __, out: self.found.update({name: change(out)}))

    def input(self, name: str, module: nn.Module, channels: slice = slice(None)) -> None:
        """Record some channels of the inputs of a module as `name`."""
        module.register_forward_pre_hook(
            lambda _, given: self.found.update({name: self.shaped(given[0][:, channels])})
        )

    def outputs(self, root: nn.Module, text: str) -> None:
        """Record outputs. Each line of `text` is a name and the path of a module in `root`."""
        for line in text.strip().splitlines():
            name, path = line.split()
            self.output(name, root.get_submodule(path))


def views_of(golden: GoldenFile) -> Views:
    """Return the photos and cameras of a golden file.

    The intrinsics in the file are divided by the image size.
    """
    images = golden.input("images")
    size = (images.shape[-2], images.shape[-1])
    lens = lens_of(golden.input("intrinsics"), size)
    return Views(images, Cameras(golden.input("extrinsics"), lens, size))


def lens_of(k: Tensor, size: tuple[int, int] = (1, 1)) -> Tensor:
    """Return fx, fy, cx, cy (..., 4) in pixels of intrinsic matrices (..., 3, 3).

    size: image size (H, W) by which the matrices were divided; (1, 1) for matrices in pixels.
    """
    lens = torch.stack([k[..., 0, 0], k[..., 1, 1], k[..., 0, 2], k[..., 1, 2]], -1)
    return lens * lens.new_tensor([size[1], size[0]] * 2)


def seeded_weights(golden: GoldenFile) -> Tensors:
    """Return the weights of a golden file that does not store them, by their published names."""
    rule = golden.config["weights"]
    # Sums of the weights, with which whoever recorded the file checked the rule.
    golden.read.add("weights_check")
    return {
        f"encoder.{name}": torch.from_numpy(
            seeded_weight(name, shape, rule["seed"], rule["factors"].get(name, 1.0))
        )
        for name, shape in golden.config["state_dict"]
    }


def model_of(golden: GoldenFile) -> QueryGaussianModel:
    """Return the model that fits the weights of a golden file, with these weights."""
    weights = golden.weights() or seeded_weights(golden)
    tree = fitting_recipe(shapes_of(weights), golden.config["kind"])[1]
    options = golden.config["options"]
    overrides = [of[options[name]] for name, of in UNDECIDED.items() if options.get(name) in of]
    if count := options.get("local_mv_match"):
        overrides.append(f"model.encoder.neighbours={count}")
    recipe = resolve(tree, overrides)
    model = recipe.build_model(pretrained=False).eval()
    model.load_state_dict(names_of(recipe).from_published(weights))
    return model


def watch_transformer(kept: Recorder, transformer: Any, size: Sequence[int], last: str) -> None:
    """Record the features before and after each window attention.

    last: name of the final features.
    """
    transformer.register_forward_pre_hook(
        lambda _, given: kept.found.update({"transformer.0": given[0]})
    )
    for index, layer in enumerate(transformer.layers):
        shift = (size[0] // 4, size[1] // 4) if index % 2 else (0, 0)

        def whole(out: Tensor, shift: tuple[int, int] = shift) -> Tensor:
            return out_of_windows(out, (size[0], size[1]), shift)

        kept.output(f"transformer_self.{index}", layer.self_attn, whole)
        kept.output(f"transformer.{index + 1}", layer, whole)
    kept.output(last, transformer, Tensor.detach)


def watch_unet(kept: Recorder, name: str, unet: Any) -> None:
    """Record all modules of a U-Net, and the inputs of the output projections of attention."""
    for path, module in unet.named_modules():
        kept.output(f"{name}.{path}", module)
        if hasattr(module, "qkv"):
            kept.input(f"{name}.{path}.attention", module.proj_out)


def warps(cameras: Cameras, poses_BVJ44: Tensor, low: Sequence[int], inverse_BVD: Tensor) -> Tensor:
    """Return the positions of pixels in J neighbour views at D depths, (B, V, J, D, h, w, 2).

    low: size (h, w) of the feature maps. inverse_BVD: inverse depths.
    """
    pairs = poses_BVJ44.shape[:3]
    lens = feature_lenses(cameras, low)[:, :, None].expand(*pairs, 4)
    depth = (1 / inverse_BVD)[:, :, None, :, None, None].expand(*pairs, -1, *low)
    return warp_grid(*(x.flatten(0, 2) for x in (depth, lens, poses_BVJ44))).unflatten(0, pairs)


def predicted(model: QueryGaussianModel, views: Views, numbers: Tensor) -> Prediction:
    """Decode the output of the networks into the Gaussians of every layer of a model.

    numbers: features of the pixels, (B, V, H, W, C).
    """
    memory = ImageMemory(numbers.flatten(1, 3), grid=(views.cameras.shape[1], *views.cameras.size))
    return model.predict(views, memory, model.queries(memory, views), range(1, model.depth + 1))


def gaussians(views: Views, numbers: Tensor, prediction: Prediction) -> Tensors:
    """Return the Gaussians of a prediction by the names of golden files.

    numbers: output of the networks for each pixel, (B, V, H, W, C).
    """
    cameras = views.cameras
    made = prediction.gaussians
    degree = degree_of(numbers.shape[-1])
    sh = numbers[..., 11 : 11 + 3 * coefficients(degree)].unflatten(-1, (3, -1))
    # The basis of the harmonics is that of e3nn.
    turn = turn_of_harmonics(cameras.c2w[..., :3, :3], degree) * band_mask(degree, sh)
    row, column = torch.meshgrid(*(torch.arange(side) for side in cameras.size), indexing="ij")
    place = torch.stack([column, row], -1) + numbers[..., 2:4].sigmoid()
    factors = quat_to_matrix(made.quats) * made.scales[..., None, :]
    return {
        "ray_xy": place / torch.tensor([cameras.size[1], cameras.size[0]]),
        "means": made.means,
        "covariances": factors @ factors.mT,
        "opacities": made.opacities,
        "scales": made.scales.unflatten(1, (cameras.shape[1], *cameras.size)),
        "rotations": camera_quaternions(numbers[..., 7:11]),
        "harmonics": torch.einsum("bvkl,bvhwxl->bvhwxk", turn, sh).flatten(1, 3),
    }


def cases_tensors(golden: GoldenFile) -> Tensors:
    """Compute every output of a file of single cases: a warp, opacities, single Gaussians."""
    lens = lens_of(golden.input("warp.intrinsics"))
    grid = warp_grid(golden.input("warp.depth"), lens, golden.input("warp.pose"))
    found = {"warp.grid": grid, "warp.warped": warped(golden.input("warp.features"), grid)}
    if "opacity.pdf" in golden.tensors:
        # First and last exponent, length, step of each schedule.
        first, last, length, step = golden.input("opacity.schedule").unbind(1)
        exponents = first + (step / length).clamp(max=1) * (last - first)
        pdf = golden.input("opacity.pdf")
        mapped = [mapped_opacity(pdf, exponent) for exponent in exponents.tolist()]
        found["opacity.mapped"] = torch.stack(mapped)
    return found | {f"adapter.{name}": x for name, x in single_gaussians(golden).items()}


def single_gaussians(golden: GoldenFile) -> Tensors:
    """Decode Gaussians that have one camera each; some have extreme rotations and values."""
    names = ("depths", "opacities", "raw", "extrinsics", "coordinates")
    depth, opacity, raw, c2w, place = (golden.input(f"adapter.{name}") for name in names)
    height, width = golden.config["image_shape"]
    lens = lens_of(golden.input("adapter.intrinsics"), (height, width))
    # Each image is the one pixel around its Gaussian, which may be outside the whole image.
    lens[:, 2:] += 0.5 - place * torch.tensor([width, height])
    views = Views(raw.new_zeros(len(raw), 1, 3, 1, 1), Cameras(c2w, lens, (1, 1))[:, None])
    sh = raw[:, 7:].unflatten(1, (3, -1)).clone()
    if "adapter.rgb" in golden.tensors:
        sh[..., 0] += (golden.input("adapter.rgb") - 0.5) / SH_C0
    numbers = [depth.log()[:, None], opacity.logit()[:, None], raw.new_zeros(len(raw), 2)]
    numbers = torch.cat([*numbers, raw[:, :7], sh.flatten(1)], 1)[:, None, None, None]
    limits = golden.config["options"]["gaussian_adapter"]
    overrides = [f"model.head.{n}={limits[f'gaussian_{n}']}" for n in ("scale_min", "scale_max")]
    recipe = f"tiny/{golden.config['kind'].removesuffix('_cases')}.yaml"
    model = qgs.compose(recipe, [*overrides, f"model.width={numbers.shape[-1]}"])
    prediction = predicted(model, views, numbers)
    pixel = prediction.state[PIXEL]
    place = prediction.state.features[:, :, None, 2:4]
    directions = ray_directions(place, pixel, unit=golden.config["kind"] == "mvsplat_cases")
    found = gaussians(views, numbers, prediction)
    found |= {"origins": pixel[:, :, 0], "directions": directions}
    return {name: x.squeeze() for name, x in found.items()}
