"""The containers that travel between components.

Shapes: B scenes, V views, H x W pixels, N queries, D width, h heads, M image tokens,
K Gaussians per query, G = N*K Gaussians. Frames: "world" is the frame of the first input camera
once poses are normalised; cameras are OpenCV (x right, y down, z forward).

Every container is frozen. A component returns a new one and never writes into the old.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self, cast

import torch
from torch import Tensor


class TensorContainer:
    """A frozen dataclass of tensors, containers and mappings of them."""

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Return a copy with every tensor moved as by `Tensor.to`.

        A dtype converts every tensor, poses, rays and other geometry included, which then is no
        longer the float32 that components count on.
        """

        copy = {name: map_tensors(lambda x: x.to(*args, **kwargs), v) for name, v in _items(self)}
        return replace(cast(Any, self), **copy)


def map_tensors(function: Callable[[Tensor], Tensor], value: Any) -> Any:
    """`value` with `function(tensor)` in place of every tensor.

    Goes into containers, mappings, lists and tuples; whatever holds no changed tensor is itself.
    """
    if isinstance(value, Tensor):
        return function(value)
    if not isinstance(value, TensorContainer | Mapping | list | tuple):
        return value
    items = list(_items(value))
    mapped = [(name, map_tensors(function, item)) for name, item in items]
    if all(new is old for (_, new), (_, old) in zip(mapped, items, strict=True)):
        return value
    if isinstance(value, TensorContainer):
        return replace(cast(Any, value), **dict(mapped))
    if isinstance(value, Mapping):
        return dict(mapped)
    return getattr(value, "_make", type(value))([item for _, item in mapped])


def named_tensors(value: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Every tensor in `value` with its dotted name, such as `gaussians.means`.

    Goes where `map_tensors` goes. name: of `value` itself.
    """
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, TensorContainer | Mapping | list | tuple):
        for key, item in _items(value):
            yield from named_tensors(item, f"{name}.{key}" if name else str(key))


def _items(value: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, TensorContainer):
        yield from ((f.name, getattr(value, f.name)) for f in fields(cast(Any, value)) if f.init)
    else:
        yield from value.items() if isinstance(value, Mapping) else enumerate(value)


def _expect(name: str, tensor: Tensor, trailing: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `tensor` ends with `trailing` (None matches any size)."""
    tail = tuple(tensor.shape[-len(trailing) :])
    matches = len(tail) == len(trailing) and all(
        want is None or want == have for want, have in zip(trailing, tail, strict=True)
    )
    if not matches:
        wanted = ", ".join("*" if size is None else str(size) for size in trailing)
        raise ValueError(f"{name} must have shape (..., {wanted}), got {tuple(tensor.shape)}")


def _expect_shape(name: str, tensor: Tensor, wanted: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != wanted:
        raise ValueError(f"{name} must have shape {wanted}, got {tuple(tensor.shape)}")


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
        _expect("Cameras.c2w", self.c2w, (4, 4))
        _expect("Cameras.intrinsics", self.intrinsics, (4,))
        if self.c2w.shape[:-2] != self.intrinsics.shape[:-1]:
            raise ValueError(
                "Cameras.c2w and Cameras.intrinsics must share their batch shape, got "
                f"{tuple(self.c2w.shape)} and {tuple(self.intrinsics.shape)}"
            )

    @property
    def shape(self) -> torch.Size:
        """Batch shape, usually (B, V)."""
        return self.c2w.shape[:-2]

    @property
    def w2c(self) -> Tensor:
        """(..., 4, 4) world-to-camera: the rigid inverse of `c2w`, differentiable."""
        rotation = self.c2w[..., :3, :3].transpose(-1, -2)
        translation = -rotation @ self.c2w[..., :3, 3:]
        return torch.cat([torch.cat([rotation, translation], -1), self.c2w[..., 3:, :]], -2)

    def __getitem__(self, index: Any) -> Cameras:
        return Cameras(self.c2w[index], self.intrinsics[index], self.size)


@dataclass(frozen=True)
class Views(TensorContainer):
    """Posed photos: images (B, V, 3, H, W) in [0, 1] and their cameras (B, V).

    masks: (B, V, 1, H, W) in [0, 1], 1 where the photo shows what is to be modelled; None for
    photos without masks.
    """

    images: Tensor
    cameras: Cameras
    masks: Tensor | None = None

    def __post_init__(self) -> None:
        if self.images.ndim != 5:
            raise ValueError(
                f"Views.images must have shape (B, V, 3, H, W), got {tuple(self.images.shape)}; "
                "add a leading dimension for a single scene"
            )
        _expect("Views.images", self.images, (3, *self.cameras.size))
        if not self.images.is_floating_point():
            raise ValueError(
                f"Views.images must be floating-point numbers in [0, 1], got {self.images.dtype}; "
                "divide 8-bit images by 255: `images.float() / 255`"
            )
        if self.images.shape[:2] != self.cameras.shape:
            raise ValueError(
                f"Views.images has {tuple(self.images.shape[:2])} scenes and views, "
                f"Views.cameras {tuple(self.cameras.shape)}"
            )
        if self.masks is not None:
            single = (*self.images.shape[:2], 1, *self.cameras.size)
            _expect_shape("Views.masks", self.masks, single)

    def select(self, index: Any) -> Views:
        """The views at `index` of every scene (a slice or a list of ints)."""
        masks = None if self.masks is None else self.masks[:, index]
        return Views(self.images[:, index], self.cameras[:, index], masks)


@dataclass(frozen=True)
class ImageMemory(TensorContainer):
    """What the encoder leaves for the decoder.

    keys, values: (B, h, M, D/h), made once for all decoder layers.
    features: (B, M, D), for components that project their own keys and values.
    patch_rays: (B, M, 6) float32 world-frame Plücker rays (moment, direction), averaged over each
        patch and not renormalised.
    grid: (V, H/P, W/P), M is its product; tokens are ordered view, row, column.
    """

    keys: Tensor
    values: Tensor
    features: Tensor
    patch_rays: Tensor
    grid: tuple[int, int, int]
    _derived: dict[tuple[str, bool, bool], Tensor] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        _expect("ImageMemory.patch_rays", self.patch_rays, (6,))
        if self.features.ndim != 3 or self.keys.ndim != 4:
            raise ValueError(
                "ImageMemory.features must have shape (B, M, D) and .keys (B, h, M, D/h), got "
                f"{tuple(self.features.shape)} and {tuple(self.keys.shape)}"
            )
        batch, tokens, _ = self.features.shape
        _expect_shape("ImageMemory.patch_rays", self.patch_rays, (batch, tokens, 6))
        _expect_shape("ImageMemory.values", self.values, tuple(self.keys.shape))
        if (self.keys.shape[0], self.keys.shape[2]) != (batch, tokens):
            raise ValueError(
                f"ImageMemory.keys must be of the {batch} scenes and {tokens} tokens of .features, "
                f"got {tuple(self.keys.shape)}"
            )
        if math.prod(self.grid) != tokens:
            raise ValueError(f"ImageMemory.grid {self.grid} must hold the {tokens} tokens")

    def once(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """What `compute` makes of this memory, computed by the first layer that asks for `name`.

        A memo, and no part of the value: copies start without it. `name` belongs to the caller,
        who prefixes it with the plugin's name. What was computed without gradients, or in
        inference mode, is computed again where they are wanted.
        """
        key = (name, torch.is_grad_enabled(), torch.is_inference_mode_enabled())
        if key not in self._derived:
            self._derived[key] = compute()
        return self._derived[key]


@dataclass(frozen=True)
class QueryState(TensorContainer):
    """The state of every query: features (B, N, D) and named fields (B, N, ...)."""

    features: Tensor
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.features.ndim != 3:
            raise ValueError(
                f"QueryState.features must have shape (B, N, D), got {tuple(self.features.shape)}"
            )
        count = tuple(self.features.shape[:2])
        for name, tensor in self.fields.items():
            if tuple(tensor.shape[:2]) != count:
                raise ValueError(
                    f"the field {name} must have shape {(*count, '...')} as the features have, "
                    f"got {tuple(tensor.shape)}"
                )

    def __getitem__(self, name: str) -> Tensor:
        return self.fields[name]

    def __contains__(self, name: object) -> bool:
        return name in self.fields

    def replace(
        self, features: Tensor | None = None, fields: Mapping[str, Tensor] | None = None
    ) -> QueryState:
        """A new state with other features and with `fields` added or replaced."""
        return QueryState(
            self.features if features is None else features, {**self.fields, **(fields or {})}
        )


@dataclass(frozen=True)
class GaussianAttributes(TensorContainer):
    """What a head reads off each query; everything of a Gaussian but its mean.

    offsets: (B, N, K, 3) raw, before any activation: a `centers` component turns them into means.
    scales: (B, N, K, 3) positive, world units. quats: (B, N, K, 4) unit, w x y z.
    opacities: (B, N, K) in (0, 1). colors: (B, N, K, 3) RGB in [0, 1].
    """

    offsets: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colors: Tensor

    def __post_init__(self) -> None:
        count = tuple(self.offsets.shape[:-1])
        _expect_shape("GaussianAttributes.opacities", self.opacities, count)
        for name, size in (("offsets", 3), ("scales", 3), ("quats", 4), ("colors", 3)):
            _expect_shape(f"GaussianAttributes.{name}", getattr(self, name), (*count, size))


@dataclass(frozen=True)
class Gaussians(TensorContainer):
    """G Gaussians per scene, ordered query by query.

    means: (B, G, 3) world. scales: (B, G, 3) standard deviations, world units.
    quats: (B, G, 4) unit, w x y z. opacities: (B, G). colors: (B, G, 3) RGB.
    """

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colors: Tensor

    def __post_init__(self) -> None:
        count = tuple(self.means.shape[:-1])
        for name, size in (("means", 3), ("scales", 3), ("quats", 4), ("colors", 3)):
            _expect_shape(f"Gaussians.{name}", getattr(self, name), (*count, size))
        _expect_shape("Gaussians.opacities", self.opacities, count)

    @property
    def count(self) -> int:
        """Gaussians per scene."""
        return self.means.shape[-2]

    def __getitem__(self, index: Any) -> Gaussians:
        return Gaussians(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


@dataclass(frozen=True)
class Rendering(TensorContainer):
    """What cameras see: rgb (B, V, 3, H, W), alpha and depth (B, V, 1, H, W).

    `rgb` is over the background, `alpha` in [0, 1], `depth` the expected camera-frame z of what
    was hit, sum(w z) / sum(w), 0 where nothing was.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor

    def __post_init__(self) -> None:
        if self.rgb.ndim != 5:
            raise ValueError(
                f"Rendering.rgb must have shape (B, V, 3, H, W), got {tuple(self.rgb.shape)}"
            )
        _expect("Rendering.rgb", self.rgb, (3, *self.rgb.shape[-2:]))
        single = (*self.rgb.shape[:2], 1, *self.rgb.shape[-2:])
        _expect_shape("Rendering.alpha", self.alpha, single)
        _expect_shape("Rendering.depth", self.depth, single)


@dataclass(frozen=True)
class SpatialSupport(TensorContainer):
    """Where queries look, for pictures: an ellipsoid per query.

    centers: (B, N, 3) world. axes: (B, N, 3, 3), its semi-axes as columns, world units.
    """

    centers: Tensor
    axes: Tensor

    def __post_init__(self) -> None:
        _expect("SpatialSupport.centers", self.centers, (3,))
        _expect_shape("SpatialSupport.axes", self.axes, (*self.centers.shape, 3))


@dataclass(frozen=True)
class LayerPrediction(TensorContainer):
    """What one decoder layer predicts: its Gaussians and the state they were decoded from."""

    gaussians: Gaussians
    state: QueryState


@dataclass(frozen=True)
class Prediction(TensorContainer):
    """A forward pass: the last layer's Gaussians and state, and those of every decoded layer.

    layers: layer number (1 is the first) to LayerPrediction, ascending.
    """

    gaussians: Gaussians
    state: QueryState
    layers: Mapping[int, LayerPrediction]
