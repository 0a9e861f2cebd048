"""The containers that travel between components.

Axes: B scenes, V views, H x W pixels, N queries, K Gaussians per query, G = N*K Gaussians,
M image tokens, D width, h heads, d = D/h. Model code ends the names of tensors with their axes,
such as `x_BND`, a digit for a fixed size; fields of containers and arguments that a contract names
go without.

Frames: "world" is the frame of the first input camera once poses are normalised; cameras are OpenCV
(x right, y down, z forward).

Containers are frozen. A component returns a new one and never writes into the one it was given.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor

from qgs.containers import TensorContainer, check_shapes, concatenated, map_tensors


def _check_unit_images(views: Any) -> None:
    """Raise ValueError for images that are no floating-point numbers."""
    if not views.images.is_floating_point():
        raise ValueError(
            f"{type(views).__name__}.images must be floating-point numbers in [0, 1], got "
            f"{views.images.dtype}; divide 8-bit images by 255: `images.float() / 255`"
        )


@dataclass(frozen=True)
class Cameras(TensorContainer):
    """Pinhole cameras of one image size.

    c2w: (..., 4, 4) camera-to-world, OpenCV axes, rigid.
    intrinsics: (..., 4) fx, fy, cx, cy in pixels; the centre of the first pixel is (0.5, 0.5).
    size: (H, W) in pixels.
    """

    c2w: Tensor
    intrinsics: Tensor
    size: tuple[int, int]

    def __post_init__(self) -> None:
        check_shapes(self, c2w="... 4 4", intrinsics="... 4")

    @property
    def shape(self) -> torch.Size:
        """Batch shape, usually (B, V)."""
        return self.c2w.shape[:-2]

    @property
    def w2c(self) -> Tensor:
        """(..., 4, 4) world-to-camera: the rigid inverse of `c2w`, differentiable."""
        # Rigid, so the inverse needs no solver, and its gradient stays exact.
        rotation = self.c2w[..., :3, :3].mT
        translation = -rotation @ self.c2w[..., :3, 3:]
        return torch.cat([torch.cat([rotation, translation], -1), self.c2w[..., 3:, :]], -2)

    def __getitem__(self, index: Any) -> Self:
        return map_tensors(lambda x: x[index], self)


@dataclass(frozen=True)
class Photos(TensorContainer):
    """Photos of unknown cameras, for models whose encoder and queries do without.

    images: (B, V, 3, H, W) in [0, 1]. times, target_time: as of `Views`.
    """

    images: Tensor
    times: Tensor | None = None
    target_time: Tensor | None = None

    def __post_init__(self) -> None:
        check_shapes(self, images="B V 3 H W", times="B V", target_time="B 1")
        _check_unit_images(self)


@dataclass(frozen=True)
class Views(TensorContainer):
    """Posed photos: images (B, V, 3, H, W) in [0, 1] and their cameras (B, V).

    masks: (B, V, 1, H, W) in [0, 1], 1 where the photo shows what is to be modelled; None for
    photos without masks. times: (B, V), when each photo was taken; None where nothing moves.
    target_time: (B, 1), of the scene that is to be reconstructed from them.
    depths: (B, V, 1, H, W), camera-frame z in world units, 0 where unknown; None without maps, and
        where no loss reads them.
    """

    images: Tensor
    cameras: Cameras
    masks: Tensor | None = None
    times: Tensor | None = None
    target_time: Tensor | None = None
    depths: Tensor | None = None

    def __post_init__(self) -> None:
        check_shapes(self.cameras, c2w="B V 4 4")
        sizes = dict(zip("BVHW", (*self.cameras.shape, *self.cameras.size), strict=True))
        shapes = {"images": "B V 3 H W", "masks": "B V 1 H W", "depths": "B V 1 H W"}
        check_shapes(self, sizes, **shapes, times="B V", target_time="B 1")
        _check_unit_images(self)

    def select(self, index: Any) -> Self:
        """The views at `index` of every scene (a slice or a list of ints), of the same time."""
        # All parts but the time have the views as their second axis.
        chosen = map_tensors(lambda x: x[:, index], self.replace(target_time=None))
        return chosen.replace(target_time=self.target_time)

    def joined(self, other: Self) -> Self:
        """These views, then `other` ones of the same scenes, of one size, with the same parts."""
        both = concatenated([x.replace(target_time=None) for x in (self, other)], 1)
        return both.replace(target_time=self.target_time)


@dataclass(frozen=True)
class ImageMemory(TensorContainer):
    """What the encoder leaves for the decoder: M tokens, with what it knows of them.

    features: (B, M, C), for components that project their own keys and values; C is the model's
        width D, or a width of the encoder's own.
    keys, values: (B, h, M, D/h), made once for all decoder layers.
    patch_rays: (B, M, 6) float32 world-frame Plücker rays (moment, direction), averaged over each
        patch and not renormalised. None where tokens are not of one patch, or cameras unknown.
    grid: (V, H/P, W/P), M is its product; tokens are ordered view, row, column. None for tokens
        that are no patches, such as learned latents.

    The encoder's `writes` say which of these are not None.
    """

    features: Tensor
    keys: Tensor | None = None
    values: Tensor | None = None
    patch_rays: Tensor | None = None
    grid: tuple[int, int, int] | None = None
    _derived: dict[tuple[str, bool, bool], Tensor] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        shape = tuple(self.features.shape)
        if self.grid is not None and shape[1:2] != (patches := math.prod(self.grid),):
            raise ValueError(f"ImageMemory.grid {self.grid}: {patches} tokens, features {shape}")
        check_shapes(
            self, features="B M C", keys="B h M D/h", values="B h M D/h", patch_rays="B M 6"
        )

    def __getitem__(self, name: str) -> Tensor:
        """A tensor that a component `reads`, such as "keys"; KeyError where there is none."""
        part = getattr(self, name, None)
        if not isinstance(part, Tensor):
            raise KeyError(f"the image memory has no {name}; its encoder does not provide it")
        return part

    def once(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """`compute()` of the first layer that asks for `name`, kept for the other layers.

        `compute` reads this memory alone. Start `name` with your plugin's name. Copies of the
        memory start with nothing kept. What was computed without gradients, or in inference mode,
        is computed again where gradients are wanted.
        """
        # What was made without gradients is of no use to a pass that needs them.
        key = (name, torch.is_grad_enabled(), torch.is_inference_mode_enabled())
        if key not in self._derived:
            self._derived[key] = compute()
        return self._derived[key]


@dataclass(frozen=True)
class QueryState(TensorContainer):
    """The state of every query: features (B, N, D) and named fields (B, N, ...).

    mask: (B, N) bool, False for places that hold no query where scenes of a batch have different
        numbers of them; None where every place holds one. What stands there is finite, no other
        query reads it, and its Gaussians have opacity 0.
    """

    features: Tensor
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    mask: Tensor | None = None

    def __post_init__(self) -> None:
        check_shapes(self, features="B N D", mask="B N")
        if self.mask is not None and self.mask.dtype != torch.bool:
            raise ValueError(f"QueryState.mask must be bool, got {self.mask.dtype}")
        count = self.features.shape[:2]
        for name, tensor in self.fields.items():
            if tensor.shape[:2] != count:
                raise ValueError(
                    f"the field {name} must have shape {(*count, '...')} as the features have, "
                    f"got {tuple(tensor.shape)}"
                )

    def __getitem__(self, name: str) -> Tensor:
        return self.fields[name]

    def __contains__(self, name: object) -> bool:
        return name in self.fields

    def replace(self, **changes: Any) -> Self:
        """A new state; `fields` are added to the present ones, or take the place of some."""
        fields = {**self.fields, **changes.pop("fields", {})}
        return super().replace(fields=fields, **changes)


_OF_GAUSSIANS = {"scales": "... 3", "quats": "... 4", "opacities": "...", "colors": "... 3"}
_OF_GAUSSIANS |= {"sh": "... C 3", "features": "... F"}

SH_COUNTS = (3, 8, 15)
"""Coefficients of spherical harmonics of degrees 1 to 1, 2 and 3; `colors` is degree 0."""


def _check_gaussians(container: TensorContainer, **shapes: str) -> None:
    """Raise ValueError for a wrong shape of what both kinds of Gaussians have, or of `shapes`."""
    check_shapes(container, **shapes, **_OF_GAUSSIANS)
    sh = getattr(container, "sh", None)
    if sh is not None and sh.shape[-2] not in SH_COUNTS:
        raise ValueError(
            f"{type(container).__name__}.sh has {sh.shape[-2]} coefficients per Gaussian; give 3, "
            "8 or 15, those of degrees 1 to 3 (degree 0 is `colors`)"
        )


@dataclass(frozen=True)
class GaussianAttributes(TensorContainer):
    """What a head reads off each query; everything of a Gaussian but its mean.

    offsets: (B, N, K, 3) raw, before any activation: a `centers` component turns them into means.
    scales: (B, N, K, 3) positive, world units. quats: (B, N, K, 4) unit, w x y z.
    opacities: (B, N, K) in (0, 1). colors: (B, N, K, 3) RGB in [0, 1], beside `sh` of any value.
    sh: (B, N, K, C, 3), features: (B, N, K, F), see `Gaussians`; None for none.
    """

    offsets: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colors: Tensor
    sh: Tensor | None = None
    features: Tensor | None = None

    def __post_init__(self) -> None:
        _check_gaussians(self, offsets="... 3")


@dataclass(frozen=True)
class Gaussians(TensorContainer):
    """G Gaussians per scene, ordered query by query.

    means: (B, G, 3) world. scales: (B, G, 3) standard deviations, world units.
    quats: (B, G, 4) unit, w x y z. opacities: (B, G). colors: (B, G, 3) RGB.
    sh: (B, G, C, 3) coefficients of real spherical harmonics in the world frame, RGB, of degrees 1
        to 1, 2 or 3 (C = 3, 8, 15) in the order of `qgs.geometry.harmonics`. Seen along the
        direction d, the colour is max(colors + sum_i Y_i(d) sh_i, 0). None: `colors` from anywhere.
    features: (B, G, F) whatever else is rendered, over 0; None for nothing.
    """

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colors: Tensor
    sh: Tensor | None = None
    features: Tensor | None = None

    def __post_init__(self) -> None:
        _check_gaussians(self, means="... 3")

    @property
    def count(self) -> int:
        """Gaussians per scene."""
        return self.means.shape[-2]

    def __getitem__(self, index: Any) -> Self:
        return map_tensors(lambda x: x[index], self)

    def most_opaque(self, count: int) -> Self:
        """The `count` most opaque of each scene, all where there are fewer, in their order."""
        # Sorted again, so that files keep the order of the queries.
        chosen = self.opacities.topk(min(count, self.count), -1).indices.sort(-1).values

        def kept(x: Tensor) -> Tensor:
            index = chosen
            # `take_along_dim` wants as many axes as x has.
            while index.ndim < x.ndim:
                index = index[..., None]
            return x.take_along_dim(index, chosen.ndim - 1)

        return map_tensors(kept, self)


@dataclass(frozen=True)
class Rendering(TensorContainer):
    """What cameras see: rgb (B, V, 3, H, W), alpha and depth (B, V, 1, H, W).

    `rgb` is over the background, `alpha` in [0, 1], `depth` the expected camera-frame z of what
    was hit, sum(w z) / sum(w), 0 where nothing was. `features` (B, V, F, H, W) are sum(w f), over
    0; None where the Gaussians have none.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    features: Tensor | None = None

    def __post_init__(self) -> None:
        shapes = {"alpha": "B V 1 H W", "depth": "B V 1 H W", "features": "B V F H W"}
        check_shapes(self, rgb="B V 3 H W", **shapes)


@dataclass(frozen=True)
class SpatialSupport(TensorContainer):
    """Where queries look, for pictures: an ellipsoid per query.

    centers: (B, N, 3) world. axes: (B, N, 3, 3), its semi-axes as columns, world units.
    """

    centers: Tensor
    axes: Tensor

    def __post_init__(self) -> None:
        check_shapes(self, centers="... 3", axes="... 3 3")


@dataclass(frozen=True)
class LayerPrediction(TensorContainer):
    """What one decoder layer predicts: its Gaussians and the state they were decoded from."""

    gaussians: Gaussians
    state: QueryState


@dataclass(frozen=True)
class Prediction(TensorContainer):
    """A forward pass: the last layer's Gaussians and state, and those of every decoded layer.

    layers: layer number (1 is the first; 0 the start, of a decoder of depth 0) to LayerPrediction,
        ascending.
    """

    gaussians: Gaussians
    state: QueryState
    layers: Mapping[int, LayerPrediction]
