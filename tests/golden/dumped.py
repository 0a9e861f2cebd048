"""Files like the golden ones, of other sizes and options, computed by our models in float64."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from published.files import read_golden
from published.models import LAST_NORM, READ_NORM, RECIPES
from published.recording import model_tensors
from qgs_published.layouts import names_of
from safetensors.torch import save_file
from torch import Tensor

from qgs.composer import resolve
from qgs.geometry.transforms import quat_to_matrix
from qgs.io.checkpoint import unique_tensors
from qgs.model import QueryGaussianModel
from qgs.types import Cameras, Views

GOLDEN = Path(__file__).parent
OF_KIND = {
    "tokengs": "tokengs_a",
    "latent": "tokengs_latent_a",
    "multiscale": "tokengs_multiscale_a",
    "dynamic": "tokengs_dynamic_a",
    "locusgs": "locus_full_a",
}


@dataclass(frozen=True)
class Sizes:
    """batch: scenes. views: input views. saturation: factor on the weights of heads."""

    batch: int = 1
    views: int = 2
    saturation: float = 1.0


def metadata(kind: str, **changes: Any) -> dict[str, Any]:
    """The metadata of the golden file of that kind, with other options."""
    config = read_golden(GOLDEN / f"{OF_KIND[kind]}.safetensors").config
    options = config["options"] | changes
    options["token_dim"] = options["enc_embed_dim"]
    gaussians = options.get("num_gaussians_per_token") or options["dec_patch_size"] ** 2
    return config | {
        "options": options,
        "gaussians_per_token": gaussians,
        "anchor_radius_min": options.get("anchor_radius_min"),
    }


def write(path: Path, config: dict[str, Any], sizes: Sizes) -> Path:
    """A file of `config`: random photos and cameras, perturbed weights, all that they lead to."""
    recipe = resolve(RECIPES[config["kind"]](config["options"]))
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)
        model = perturbed(recipe.build_model().eval(), sizes.saturation)
        views = random_views(sizes, config["options"]["img_size"])
        if config["options"].get("time_embedding"):
            times = torch.rand(sizes.batch, sizes.views + 1)
            views = replace(views, times=times[:, 1:], target_time=times[:, :1])
        tuned = torch.randn_like(model.encoder(views).features) if model.encoder.tunable else None
    weights = {name: tensor.clone() for name, tensor in unique_tensors(model).items()}
    published = {theirs: weights[ours] for ours, theirs in names_of(recipe).published.items()}
    if not config["options"].get("use_multiscale_encoder"):
        published = {name.replace(READ_NORM, LAST_NORM): x for name, x in published.items()}
    exact = None if tuned is None else tuned.double()
    computed = model_tensors(model.double(), views.to(torch.float64), exact)
    tensors = {f"weights.{name}": tensor for name, tensor in published.items()}
    tensors |= {name: tensor.float() for name, tensor in computed.items()}
    tensors |= {"rgb": views.images, "c2w": views.cameras.c2w}
    tensors["intrinsics"] = views.cameras.intrinsics
    optional = {"tuned_latents": tuned, "times": views.times, "target_time": views.target_time}
    tensors |= {name: tensor for name, tensor in optional.items() if tensor is not None}
    outputs = sorted(set(computed) - {"images", "rays_o", "rays_d", "plucker"})
    save(path, tensors, config | {"outputs": outputs})
    return path


def save(path: Path, tensors: dict[str, Tensor], config: dict[str, Any]) -> None:
    """Write a file in the golden format."""
    contiguous = {name: tensor.contiguous().clone() for name, tensor in tensors.items()}
    save_file(contiguous, path, {"config": json.dumps(config)})


@torch.no_grad()
def perturbed(model: QueryGaussianModel, saturation: float) -> QueryGaussianModel:
    """Weights at which every detail shows, heads scaled by `saturation`."""
    for name, parameter in model.named_parameters():
        if name.endswith(".gamma"):
            parameter.fill_(0.5)
        parameter.add_(0.05 * torch.randn_like(parameter))
        if name.startswith(("head.", "refinements.")):
            parameter.mul_(saturation)
    return model


def random_views(sizes: Sizes, size: list[int]) -> Views:
    """Cameras near each other that look along z; the first is the world's frame."""
    height, width = size
    c2w = torch.eye(4).repeat(sizes.batch, sizes.views, 1, 1)
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(sizes.batch, sizes.views - 1, 4)
    c2w[:, 1:, :3, :3] = quat_to_matrix(torch.nn.functional.normalize(quats, dim=-1))
    c2w[:, 1:, :3, 3] = 0.3 * torch.randn(sizes.batch, sizes.views - 1, 3)
    intrinsics = torch.tensor([width, width, width / 2, height / 2]).expand(*c2w.shape[:2], 4)
    rgb = torch.rand(sizes.batch, sizes.views, 3, height, width)
    return Views(rgb, Cameras(c2w, intrinsics, (height, width)))
