"""Components that keep the contract in ways that a check could take for a fault."""

from itertools import pairwise
from typing import Literal

import torch
import torch.nn.functional as F
from contract_mutants.mutant import sound
from contract_mutants.renderers import ChangedResult, RefusesWhatItDeclares
from contract_mutants.spatial import BiasedAttention, Extended, PlacesByALayer
from einops import rearrange
from torch import nn

from qgs.contracts import PatchEncoder, memory_fields
from qgs.geometry.rays import patch_rays, plucker_rays
from qgs.tokengs import ContentCrossAttention, MlpFeedForward, MultiViewViT
from qgs.tokengs.blocks import merge_heads
from qgs.tokengs.encoder import keys_and_values
from qgs.types import ImageMemory


@sound
class DropsOut(MlpFeedForward):
    def forward(self, features):
        return F.dropout(super().forward(features), 0.2, self.training)


@sound
class TurnsAutocastOff(PlacesByALayer):
    """PyTorch's own idiom for float32 geometry, which torch refuses on meta."""

    def forward(self, state):
        center = state["place.center"]
        with torch.autocast(center.device.type, enabled=False):
            bounded = center / (1 + center.norm(dim=-1, keepdim=True))
        return self.attention(self.norm(state.features + self.place(bounded)), state.mask)

    def explain(self, state, queries):
        return None


@sound
class FusesInHalf(ContentCrossAttention):
    """Attention by one kernel in half precision, spelled out in any other."""

    def forward(self, state, memory):
        keys = memory.keys
        values = memory.values
        query = self.core.project(state.features).to(values.dtype)
        if values.dtype == torch.bfloat16:
            read = F.scaled_dot_product_attention(query, keys, values)
        else:
            read = (query @ keys.mT * query.shape[-1] ** -0.5).softmax(-1) @ values
        return self.core.out_proj(merge_heads(read))


class ChangedEncoder(ChangedResult, MultiViewViT):
    """A sound encoder, whose input or output mutants change."""

    class Config(MultiViewViT.Config):
        depth: int = 1

    def given(self, views):
        return views

    def forward(self, views):
        return super().forward(self.given(views))


@sound
class SeesFar(Extended, ChangedEncoder):
    """Convolutions over 19 pixels, before patches of 8 are cut."""

    def add(self, dims):
        layers = [(3, 16), (16, 16), (16, 3)]
        self.stem = nn.Sequential(
            *(nn.Sequential(nn.Conv2d(i, o, 7, padding=3), nn.Tanh()) for i, o in layers)
        )

    def given(self, views):
        seen = self.stem(views.images.flatten(0, 1)).unflatten(0, views.images.shape[:2])
        return views.replace(images=seen)


class StridedConvolutions(Extended, PatchEncoder):
    """Each halves the sides. Kernels of 3 put a token's centre nearly half a patch off."""

    class Config(PatchEncoder.Config):
        kernel: int = 3
        patch_size: Literal[4, 8, 16] = 8

    def add(self, dims):
        sizes = pairwise([9, *[dims.width] * (self.config.patch_size.bit_length() - 1)])
        layers = [(nn.Conv2d(i, o, self.config.kernel, 2, padding=1), nn.GELU()) for i, o in sizes]
        self.layers = nn.Sequential(*(part for layer in layers for part in layer))
        self.kv_proj = nn.Linear(dims.width, 2 * dims.width)
        self.k_norm = nn.LayerNorm(dims.width // dims.heads)

    def ordered(self, x_BVDHW):
        return x_BVDHW

    def forward(self, views):
        rays = plucker_rays(views.cameras)
        x = self.layers(torch.cat([views.images, rays], 2).flatten(0, 1))
        x = self.ordered(x.unflatten(0, views.images.shape[:2]))
        features = rearrange(x, "b v d h w -> b (v h w) d")
        keys, values = keys_and_values(features, self.kv_proj, self.k_norm)
        rays = patch_rays(rays, self.config.patch_size)
        return ImageMemory(features, keys, values, rays, self.grid(views))


@sound
class ConvolvesByThree(StridedConvolutions): ...


@sound
class ConvolvesByFour(StridedConvolutions):
    class Config(StridedConvolutions.Config):
        kernel: int = 4


@sound
class RefusesIntrinsics(RefusesWhatItDeclares):
    camera_gradients = ("c2w",)


@sound
class EachHeadSeesASide(BiasedAttention):
    """A bias for each head that hides what lies left, or right, of the camera's axis."""

    reads = memory_fields("keys", "values", "patch_rays")

    def bias(self, state, memory):
        side_B1M = memory.patch_rays[:, None, :, 3]
        heads = torch.arange(self.dims.heads).to(side_B1M.device) % 2 == 1
        bias_BhM = side_B1M.square().masked_fill((side_B1M < 0.05) == heads[:, None], -torch.inf)
        return bias_BhM[:, :, None].expand(-1, -1, state.features.shape[1], -1)
