"""Containers of tensors, which components exchange.

Axes: B scenes, V views, H x W pixels, N queries, K Gaussians per query, G = N*K Gaussians,
M image tokens, D width, h heads, d = D/h. Model code ends the names of tensors with their axes,
such as `x_BND`; a digit is a fixed size. Fields of containers and arguments named by a contract
have no such ending.

Frames: "world" is the model's frame, by default that of the first input camera; cameras are
OpenCV (x right, y down, z forward).

Containers are frozen. A component returns a new container and never changes its inputs.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor

from qgs.containers import TensorContainer, check_shapes, concatenated, map_tensors

Size = tuple[int, int]
"""Height and width in pixels."""
World = tuple[Tensor, Tensor]
"""Reference pose (4, 4) and 0-d scale of a coordinate frame, see `qgs.data.samples.own_world`."""


def _check_unit_images(views: Any) -> None:
    """Raise ValueError for images that are not floating-point numbers."""
    if not views.images.is_floating_point():
        raise ValueError(
            f"{type(views).__name__}.images must be floating-point numbers in [0, 1], got "
            f"{views.images.dtype}; divide 8-bit images by 255: `images.float() / 255`"
        )


class _Batch(TensorContainer):
    """Container whose index selects from the leading axes of all of its tensors."""

    def __getitem__(self, index: Any) -> Self:
        return map_tensors(lambda x: x[index], self)


@dataclass(frozen=True)
class Cameras(_Batch):
    """Pinhole cameras of one image size.

    c2w: (..., 4, 4) camera-to-world, OpenCV axes, rigid.
    intrinsics: (..., 4) fx, fy, cx, cy in pixels; the centre of the first pixel is (0.5, 0.5).
    size: (H, W) in pixels.
    """

    c2w: Tensor
    intrinsics: Tensor
    size: Size

    def __post_init__(self) -> None:
        check_shapes(self, c2w="... 4 4", intrinsics="... 4")

    @property
    def shape(self) -> torch.Size:
        """Shape of the batch of cameras, usually (B, V)."""
        return self.c2w.shape[:-2]

    @property
    def w2c(self) -> Tensor:
        """World-to-camera poses (..., 4, 4): the rigid inverse of `c2w`, differentiable."""
        # Rigid, so the inverse needs no solver, and its gradient stays exact.
        rotation = self.c2w[..., :3, :3].mT
        translation = -rotation @ self.c2w[..., :3, 3:]
        return torch.cat([torch.cat([rotation, translation], -1), self.c2w[..., 3:, :]], -2)


@dataclass(frozen=True)
class Photos(TensorContainer):
    """Photos without cameras, for models whose encoder and queries do not need them.

    images: (B, V, 3, H, W) in [0, 1].
    times: (B, V), time of each photo; None for static scenes.
    target_time: (B, 1), time at which to reconstruct the scene; None for static scenes.
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

    masks: (B, V, 1, H, W) in [0, 1], 1 on the object to reconstruct; None without masks.
    times: (B, V), time of each photo; None for static scenes.
    target_time: (B, 1), time at which to reconstruct the scene; None for static scenes.
    depths: (B, V, 1, H, W), camera-frame z in world units, 0 where unknown; None without depth
        maps, or if no loss reads them.
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
        check_shapes(
            self,
            sizes,
            images="B V 3 H W",
            masks="B V 1 H W",
            depths="B V 1 H W",
            times="B V",
            target_time="B 1",
        )
        _check_unit_images(self)

    def select(self, index: Any) -> Self:
        """Select the views at `index` (slice or list of ints) of every scene; keep target_time."""
        # All parts but the time have the views as their second axis.
        chosen = map_tensors(lambda x: x[:, index], self.replace(target_time=None))
        return chosen.replace(target_time=self.target_time)

    def joined(self, other: Self) -> Self:
        """Append `other` views of the same scenes, which must have equal image size and fields."""
        both = concatenated([x.replace(target_time=None) for x in (self, other)], 1)
        return both.replace(target_time=self.target_time)


@dataclass(frozen=True)
class ImageMemory(TensorContainer):
    """Image memory, the encoder's output for the decoder: M tokens and their properties.

    features: (B, M, C), for components that project their own keys and values; C is the model's
        width D, or another width of the encoder.
    keys, values: (B, h, M, D/h), computed once for all decoder layers.
    patch_rays: (B, M, 6) float32 world-frame Plücker rays (moment, direction), averaged over each
        patch and not renormalised. None if tokens are not single patches, or cameras are unknown.
    grid: (V, H/P, W/P) for patches of side P, with the product M; tokens are ordered by view, row,
        column. None for tokens that are not patches, such as learned latents.

    The encoder's `writes` lists the parts that are not None. `once(name, compute)` returns a tensor
    computed from this memory, and keeps it for later layers.
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
            raise ValueError(
                f"ImageMemory.grid {self.grid} needs {patches} tokens, but the features have shape "
                f"{shape}"
            )
        check_shapes(
            self, features="B M C", keys="B h M D/h", values="B h M D/h", patch_rays="B M 6"
        )

    def __getitem__(self, name: str) -> Tensor:
        """Return a tensor by name, such as "keys"; raise KeyError if it is None."""
        part = getattr(self, name, None)
        if not isinstance(part, Tensor):
            raise KeyError(f"the image memory has no {name}; its encoder does not provide it")
        return part

    def once(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """Return `compute()`, computed in the first decoder layer and cached for later layers.

        name: key of the cache; start it with your plugin's name. `compute` must read only this
        memory. Copies of the memory start with an empty cache. Results without gradients, or from
        inference mode, are not used for calls with gradients.
        """
        # torch.compile cannot trace the question, and makes graphs for each mode.
        inference = not torch.compiler.is_compiling() and torch.is_inference_mode_enabled()
        # What was made without gradients is of no use to a pass that needs them.
        key = (name, torch.is_grad_enabled(), inference)
        if key not in self._derived:
            self._derived[key] = compute()
        return self._derived[key]


@dataclass(frozen=True)
class QueryState(TensorContainer):
    """The state of every query: features (B, N, D) and named fields (B, N, ...).

    mask: (B, N) bool, for scenes with different numbers of queries; False marks padding, None means
        no padding. Values of padding are finite, no query reads them, and the Gaussians of padding
        have opacity 0.
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

    def replace(self, **changes: Any) -> Self:
        """Return a changed copy; `fields` adds fields, or replaces fields of equal name."""
        fields = {**self.fields, **changes.pop("fields", {})}
        return super().replace(fields=fields, **changes)


_OF_GAUSSIANS = {
    "scales": "... 3",
    "quats": "... 4",
    "opacities": "...",
    "colors": "... 3",
    "sh": "... C 3",
    "features": "... F",
}

SH_COUNTS = (3, 8, 15)
"""Numbers of spherical-harmonic coefficients for degrees 1 to 1, 1 to 2 and 1 to 3; degree 0 is
`colors`."""


def _check_gaussians(container: Any, **shapes: str) -> None:
    """Raise ValueError for a wrong shape of a field in `shapes` or a common field of Gaussians."""
    check_shapes(container, **shapes, **_OF_GAUSSIANS)
    sh = container.sh
    if sh is not None and sh.shape[-2] not in SH_COUNTS:
        raise ValueError(
            f"{type(container).__name__}.sh has {sh.shape[-2]} coefficients per Gaussian; give 3, "
            "8 or 15, for a highest degree of 1, 2 or 3 (degree 0 is `colors`)"
        )


@dataclass(frozen=True)
class GaussianAttributes(TensorContainer):
    """Output of a head for each query: all attributes of its Gaussians except the means.

    offsets: (B, N, K, 3) raw, before any activation; a `centers` component turns them into means.
    scales: (B, N, K, 3) positive, world units. quats: (B, N, K, 4) unit, w x y z.
    opacities: (B, N, K) in (0, 1). colors: (B, N, K, 3) RGB in [0, 1], even if `sh` is set.
    sh: (B, N, K, C, 3) coefficients of spherical harmonics, as in `Gaussians`; None for colours
        that are the same from all directions.
    features: (B, N, K, F) further values to render; None if there are none.
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
class Gaussians(_Batch):
    """Gaussians, G per scene, ordered query by query.

    means: (B, G, 3) world. scales: (B, G, 3) standard deviations, world units.
    quats: (B, G, 4) unit, w x y z. opacities: (B, G). colors: (B, G, 3) RGB.
    sh: (B, G, C, 3) RGB coefficients of real spherical harmonics in the world frame, for degrees 1
        to L (C = 3, 8 or 15 for L = 1, 2 or 3), in the order of `qgs.geometry.harmonics`. Seen
        along the unit direction d, the colour is max(colors + sum_i Y_i(d) sh_i, 0) with the
        harmonics Y_i. None: the colour is `colors` from all directions.
    features: (B, G, F) further values to render, over a background of 0; None if there are none.
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
        """Number of Gaussians per scene."""
        return self.means.shape[-2]

    def most_opaque(self, count: int) -> Self:
        """Return the `count` most opaque Gaussians of each scene, in unchanged order.

        Returns all Gaussians if there are fewer.
        """
        chosen = self.opacities.topk(min(count, self.count), -1).indices
        # By a mask, so that files keep the order of the queries.
        kept = torch.zeros_like(self.opacities, dtype=torch.bool).scatter(-1, chosen, True)
        return map_tensors(lambda x: x[kept].unflatten(0, chosen.shape), self)


@dataclass(frozen=True)
class Rendering(TensorContainer):
    """Rendered images: rgb (B, V, 3, H, W), alpha and depth (B, V, 1, H, W).

    Each Gaussian has a blending weight w at a pixel. `rgb` is the sum of weighted colours plus
    (1 - alpha) times the background. `alpha` is sum(w), in [0, 1]. `depth` is the mean camera-frame
    z, sum(w z) / sum(w), or 0 where no Gaussian was hit. `features` (B, V, F, H, W) is sum(w f);
    None for Gaussians without features f.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    features: Tensor | None = None

    def __post_init__(self) -> None:
        check_shapes(
            self, rgb="B V 3 H W", alpha="B V 1 H W", depth="B V 1 H W", features="B V F H W"
        )


@dataclass(frozen=True)
class SpatialSupport(TensorContainer):
    """Spatial support of queries, to visualise: an ellipsoid per query.

    centers: (B, N, 3) world frame. axes: (B, N, 3, 3), semi-axes as columns, in world units.
    """

    centers: Tensor
    axes: Tensor

    def __post_init__(self) -> None:
        check_shapes(self, centers="... 3", axes="... 3 3")


@dataclass(frozen=True)
class LayerPrediction(TensorContainer):
    """Prediction of one decoder layer: its Gaussians and the state that they were decoded from."""

    gaussians: Gaussians
    state: QueryState


@dataclass(frozen=True)
class Prediction(TensorContainer):
    """Output of a forward pass: Gaussians and query state of the last layer.

    layers: prediction of each decoded layer, by ascending layer number. 1 is the first layer; 0 is
        the initial state, only in a decoder of depth 0.
    """

    gaussians: Gaussians
    state: QueryState
    layers: Mapping[int, LayerPrediction]
