"""TokenGS and every LocusGS variant against numbers computed with the released code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from golden.published import GOLDEN, our_weights, read_golden, recipe_of
from torch import Tensor, nn

import qgs
from qgs.geometry.rays import camera_rays, plucker_rays
from qgs.model import QueryGaussianModel

TOLERANCE = {"rtol": 1e-4, "atol": 5e-5}
MODELS = sorted(path.stem for path in GOLDEN.glob("*.safetensors") if path.stem != "loss_a")


def compute(model: QueryGaussianModel, views: qgs.Views) -> dict[str, Tensor]:
    """Everything a golden file can hold, under its names."""
    found: dict[str, Tensor] = {}
    hooks = [
        model.encoder.blocks[0].register_forward_pre_hook(_keep_input(found, "encoder_in")),
        model.encoder.register_forward_hook(_keep_memory(found)),
        model.decoder[0].register_forward_pre_hook(_keep_state(found, model, 0)),
    ]
    for index, layer in enumerate(model.decoder):
        hooks += _layer_hooks(found, index, layer)
        refinement = model.refinements[0]
    numbers = iter(range(1, model.depth + 1))
    hooks.append(
        refinement.register_forward_hook(
            lambda module, inputs, state: _store_state(found, model, next(numbers), state)
        )
    )
    with torch.no_grad():
        prediction = model(views, layers=range(1, model.depth + 1))
    for hook in hooks:
        hook.remove()
    found["gaussians"] = _packed(prediction.gaussians)
    for number, layer in prediction.layers.items():
        found[f"gaussians_layer.{number}"] = _packed(layer.gaussians)
    return found


def _keep_input(found: dict[str, Tensor], name: str) -> Callable[..., None]:
    return lambda module, inputs: found.update({name: inputs[0]})


def _keep_memory(found: dict[str, Tensor]) -> Callable[..., None]:
    def hook(module: nn.Module, inputs: Any, memory: Any) -> None:
        found["encoder_features"] = memory.features
        found["keys"], found["values"] = memory.keys, memory.values
        found["plucker_patch"] = memory.patch_rays

    return hook


def _keep_state(found: dict[str, Tensor], model: Any, number: int) -> Callable[..., None]:
    return lambda module, inputs: _store_state(found, model, number, inputs[0])


def _store_state(found: dict[str, Tensor], model: Any, number: int, state: Any) -> None:
    found[f"tokens.{number}"] = state.features
    if "anchor.center" in state.fields:
        support = model.queries.support(state)
        found[f"anchor_center.{number}"] = support.centers
        found[f"anchor_radius.{number}"] = support.axes[..., 0, :1]


def _layer_hooks(found: dict[str, Tensor], index: int, layer: Any) -> list[Any]:
    def cross(module: nn.Module, inputs: Any, update: Tensor) -> None:
        found[f"cross_attn_out.{index}"] = update
        if hasattr(module, "raw_gamma"):
            found[f"geo_gamma.{index}"] = module.gamma
            found[f"geo_bias.{index}"] = module.bias(*inputs) / module.gamma

    def keep_self(module: nn.Module, inputs: Any, update: Tensor) -> None:
        found[f"self_attn_out.{index}"] = update

    hooks = [
        layer.cross_attention.register_forward_hook(cross),
        layer.self_attention.register_forward_hook(keep_self),
    ]
    if hasattr(layer.self_attention, "position_mlp"):
        hooks.append(
            layer.self_attention.position_mlp.register_forward_hook(
                lambda module, inputs, output: found.update(
                    {f"anchor_sine.{index}": inputs[0], f"anchor_pe.{index}": output}
                )
            )
        )
    return hooks


def _packed(gaussians: qgs.Gaussians) -> Tensor:
    g = gaussians
    return torch.cat([g.means, g.opacities[..., None], g.scales, g.quats, g.colors], -1)


def test_the_published_models_are_all_here() -> None:
    variants = (
        "anchor_offset", "center_only_bias", "content_cross_attn", "content_self_attn",
        "free_center", "full", "no_radius_state", "static_radius",
    )  # fmt: skip
    assert sorted([*(f"locus_{variant}_a" for variant in variants), "tokengs_a"]) == MODELS


@pytest.mark.parametrize("name", MODELS)
def test_every_tensor_of_a_golden_file(name: str) -> None:
    golden, config = read_golden(name)
    model = qgs.compose(recipe_of(config)).eval()
    model.load_state_dict(our_weights(golden), strict=True)
    size = tuple(config["options"]["img_size"])
    cameras = qgs.Cameras(golden["c2w"], golden["intrinsics"], size)
    found = compute(model, qgs.Views(golden["rgb"], cameras))

    missing = set(config["outputs"]) - set(found)
    if config["options"].get("use_anchor_radius") is False:
        missing -= {key for key in missing if key.startswith("anchor_radius")}
    assert not missing
    for key in set(config["outputs"]) & set(found):
        torch.testing.assert_close(
            found[key], golden[key], **TOLERANCE, msg=lambda m, k=key: f"{k}: {m}"
        )


@pytest.mark.parametrize("name", ["tokengs_a", "locus_full_a"])
def test_rays_of_a_golden_file(name: str) -> None:
    golden, config = read_golden(name)
    cameras = qgs.Cameras(golden["c2w"], golden["intrinsics"], tuple(config["options"]["img_size"]))
    origins, directions = camera_rays(cameras)
    torch.testing.assert_close(origins.movedim(-1, 2), golden["rays_o"], **TOLERANCE)
    torch.testing.assert_close(directions.movedim(-1, 2), golden["rays_d"], **TOLERANCE)
    torch.testing.assert_close(plucker_rays(cameras), golden["plucker"], **TOLERANCE)
