"""All tensors that a file of a model can hold, computed here under the file's names.

tokens.l, anchor_*.l: the state after l layers. *.i: inside the 0-based layer i.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import torch
from qgs_locus.anchors import AnchoredQueries
from qgs_locus.cross_attention import RayBiasedCrossAttention
from qgs_locus.fields import CENTER, RAW_RADIUS, support_radius
from qgs_locus.self_attention import AnchorAwareSelfAttention
from qgs_zoo.tokengs2026.latents import LatentBottleneck
from qgs_zoo.tokengs2026.times import time_features
from torch import Tensor, nn

from qgs.geometry.rays import camera_rays, plucker_rays
from qgs.model import QueryGaussianModel
from qgs.tokengs import CrossSelfMlp
from qgs.tokengs.encoder import PatchViT, imagenet_normalised
from qgs.types import Gaussians, ImageMemory, QueryState, Views


@torch.no_grad()
def model_tensors(
    model: QueryGaussianModel, views: Views, tuned_latents: Tensor | None = None
) -> dict[str, Tensor]:
    """Run `model` and return every tensor that a file can hold.

    tuned_latents: (B, L, D), to decode in place of those that the photos give.
    """
    origins, directions = camera_rays(views.cameras)
    found = {
        "images": imagenet_normalised(views.images),
        "rays_o": origins.movedim(-1, -3),  # channels before pixels
        "rays_d": directions.movedim(-1, -3),
        "plucker": plucker_rays(views.cameras),
    }
    for name, times in (("input", views.times), ("target", views.target_time)):
        channels = getattr(model.encoder.config, "time_channels", 0)
        if times is not None and channels:
            found[f"time_embedding_{name}"] = time_features(times, channels)
    with ExitStack() as stack:
        for handle in _Recorder(model, found).handles():
            stack.callback(handle.remove)
        prediction = model(views, layers=range(1, model.depth + 1))
    found["gaussians"] = _packed(prediction.gaussians)
    for number, layer in prediction.layers.items():
        found[f"gaussians_layer.{number}"] = _packed(layer.gaussians)
    if tuned_latents is not None:
        memory = model.encoder(views)
        state = model.queries(memory, views)
        memory = model.encoder.project(tuned_latents, memory)
        tuned = model.predict(views, memory, state)
        found["gaussians_of_tuned_latents"] = _packed(tuned.gaussians)
    return found


def _packed(g: Gaussians) -> Tensor:
    return torch.cat([g.means, g.opacities[..., None], g.scales, g.quats, g.colors], -1)


class _Recorder:
    """Forward hooks that store inputs and outputs of modules; layers run in order."""

    def __init__(self, model: QueryGaussianModel, found: dict[str, Tensor]) -> None:
        self.model = model
        self.found = found
        self.layer = 0

    def handles(self) -> Iterator[Any]:
        encoder = self.model.encoder
        assert isinstance(encoder, PatchViT)
        first = encoder.blocks[0] if len(encoder.blocks) else encoder.get_submodule("norm")
        yield first.register_forward_pre_hook(self._encoder_input)
        if isinstance(encoder, LatentBottleneck):
            yield encoder.feature_kv_proj.register_forward_pre_hook(self._read_features)
            for index, block in enumerate(encoder.latent_blocks):
                yield block.register_forward_pre_hook(partial(self._latents_before, index))
                for part, name in (("cross_attention", "cross"), ("self_attention", "self")):
                    key = f"latent_{name}_attn_out.{index}"
                    hook = partial(self._output, key)
                    yield block.get_submodule(part).register_forward_hook(hook)
                yield block.register_forward_hook(
                    partial(self._output, f"scene_latents.{index + 1}")
                )
        yield encoder.register_forward_hook(self._memory)
        for index, layer in enumerate(self.model.decoder):
            assert isinstance(layer, CrossSelfMlp)
            yield layer.register_forward_pre_hook(partial(self._entering, index))
            yield layer.cross_attention.register_forward_hook(self._cross_attention)
            yield layer.self_attention.register_forward_hook(self._self_attention)
            if isinstance(layer.self_attention, AnchorAwareSelfAttention):
                position_mlp = layer.self_attention.position_mlp
                yield position_mlp.register_forward_hook(self._position_embedding)
        for refinement in self.model.refinements:
            yield refinement.register_forward_hook(self._refined)

    def _encoder_input(self, module: nn.Module, args: tuple[Tensor]) -> None:
        self.found["encoder_in"] = args[0]

    def _memory(self, module: nn.Module, args: Any, memory: ImageMemory) -> None:
        self.found["keys"] = memory["keys"]
        self.found["values"] = memory["values"]
        # Then its features are those of image tokens.
        if memory.patch_rays is not None:
            self.found["encoder_features"] = memory.features
            self.found["plucker_patch"] = memory.patch_rays

    def _read_features(self, module: nn.Module, args: tuple[Tensor]) -> None:
        self.found["encoder_features"] = args[0]

    def _latents_before(self, index: int, module: nn.Module, args: tuple[Tensor, ...]) -> None:
        self.found.setdefault(f"scene_latents.{index}", args[0])

    def _output(self, name: str, module: nn.Module, args: Any, output: Tensor) -> None:
        self.found[name] = output

    def _entering(
        self, index: int, module: nn.Module, args: tuple[QueryState, ImageMemory]
    ) -> None:
        self.layer = index
        if index == 0:
            self._state(args[0], 0)

    def _refined(self, module: nn.Module, args: Any, state: QueryState) -> None:
        self._state(state, self.layer + 1)

    def _state(self, state: QueryState, number: int) -> None:
        self.found[f"tokens.{number}"] = state.features
        queries = self.model.queries
        if isinstance(queries, AnchoredQueries):
            self.found[f"anchor_center.{number}"] = state[CENTER]
            if queries.config.radius:
                radius = support_radius(state[RAW_RADIUS], queries.config)
                self.found[f"anchor_radius.{number}"] = radius

    def _cross_attention(
        self, module: nn.Module, args: tuple[QueryState, ImageMemory], update: Tensor
    ) -> None:
        self.found[f"cross_attn_out.{self.layer}"] = update
        if isinstance(module, RayBiasedCrossAttention):
            self.found[f"geo_gamma.{self.layer}"] = module.gamma
            bias = module.bias(*args).dense()
            self.found[f"geo_bias.{self.layer}"] = bias / module.gamma

    def _self_attention(self, module: nn.Module, args: Any, update: Tensor) -> None:
        self.found[f"self_attn_out.{self.layer}"] = update

    def _position_embedding(self, module: nn.Module, args: tuple[Tensor], output: Tensor) -> None:
        self.found[f"anchor_sine.{self.layer}"] = args[0]
        self.found[f"anchor_pe.{self.layer}"] = output
