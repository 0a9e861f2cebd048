"""`qgs/cpu`: projection and blending by tiles of 16 x 16 pixels, in numba."""

from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from qgs.contracts import MissingExtraError, Renderer, RendererConfig
from qgs.contracts.renderer import background_of, check_inputs, colors_of, raise_precision
from qgs.machine import can_compile, in_threads
from qgs.renderers.reference import CLAMP_MARGIN, resolve
from qgs.types import Cameras, Gaussians, Rendering

_TILE = 16
# Gaussians per unit of the projection.
_CHUNK = 512
# Units of work per call, so that a few large images still fill a few cores.
_MIN_UNITS = 8


class CpuRenderer(Renderer):
    """Fast on a CPU; the same bits on every run, whatever the number of threads.

    Computes in float32 on `torch.get_num_threads()` threads; float64 inputs come back in float64,
    at float32 accuracy. Gradients cannot be differentiated again.
    """

    name = "cpu"
    devices = ("cpu",)

    def __init__(self, config: RendererConfig) -> None:
        super().__init__(config)
        if not can_compile():
            raise MissingExtraError(
                "the renderer qgs/cpu needs numba, which is not installed: run "
                "`pip install numba`, or choose `renderer: {type: qgs/torch}` "
                "(much slower)"
            )

    def forward(
        self, gaussians: Gaussians, cameras: Cameras, background: Tensor | None = None
    ) -> Rendering:
        """See `Renderer`. Raises ValueError for tensors that are not on the CPU."""
        check_inputs(gaussians, cameras)
        if gaussians.means.device.type != "cpu":
            raise ValueError(
                f"qgs/cpu renders CPU tensors, got Gaussians on {gaussians.means.device}; move "
                "them with .to('cpu') or choose `renderer: {type: qgs/auto}`"
            )
        config = self.config
        # Half precision has no digits for pixels.
        with torch.autocast("cpu", enabled=False):
            gaussians, cameras = raise_precision(gaussians, cameras)
            backdrop = background_of(background, config.background, gaussians.means)
            sums = self._sums(gaussians, colors_of(gaussians, cameras), cameras)
            return resolve(sums, backdrop, self._features(gaussians, cameras))

    def _sums(self, gaussians: Gaussians, colors: Tensor, cameras: Cameras) -> Tensor:
        """Sums (B, V, 5, H, W) with `colors` (B, G, 3) or (B, V, G, 3) in place of theirs."""
        inputs = (
            gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities,
            colors, cameras.c2w, cameras.intrinsics,
        )  # fmt: skip
        sums = _Splat.apply(*(tensor.float() for tensor in inputs), cameras.size, self.config)
        return sums.to(gaussians.means.dtype)

    def _features(self, gaussians: Gaussians, cameras: Cameras) -> Tensor | None:
        """Sums (B, V, F, H, W) of the features, three at a time as if they were colours."""
        if gaussians.features is None:
            return None
        threes = F.pad(gaussians.features, (0, -gaussians.features.shape[-1] % 3)).split(3, -1)
        parts = [self._sums(gaussians, three, cameras)[:, :, :3] for three in threes]
        return torch.cat(parts, 2)[:, :, : gaussians.features.shape[-1]]


class _Splat(torch.autograd.Function):
    """means, scales, quats, opacities, colors, c2w, intrinsics -> sums (B, V, 5, H, W).

    colors: (B, G, 3), or (B, V, G, 3) of every view.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        from qgs.kernels import rasterisation as kernels
        from qgs.kernels.projection import project_unit

        *tensors, size, config = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        means, scales, quats, opacities, colors, c2w, lenses = _arrays(*tensors)
        (batch, views), count = c2w.shape[:2], means.shape[1]
        splats = tensors[0].new_empty((batch, views, count, kernels.SPLAT_FIELDS))
        sums = splats.new_empty((batch, views, kernels.SUMS, *size))
        rows, out = _arrays(splats, sums)
        projection, blending = _limits(config)

        def project(scene: int, bounds: tuple[int, int], part: int) -> None:
            project_unit(
                means[scene], scales[scene], quats[scene], opacities[scene],
                c2w[scene], lenses[scene], bounds, _float32(size), projection, rows[scene],
            )  # fmt: skip

        def blend(image: tuple[int, int], stripe: tuple[int, int], part: int) -> None:
            scene = opacities[image[0]], colors[image[: colors.ndim - 2]]
            kernels.forward_unit(rows[image], *scene, stripe, blending, out[image])

        stripes = _image_units(batch, views, size[0])
        # First all projections: every stripe of an image sorts all of its splats.
        in_threads(project, _scene_units(batch, count))
        in_threads(blend, stripes)
        ctx.save_for_backward(*tensors, splats, sums)
        ctx.config = config
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        from qgs.kernels import rasterisation as kernels
        from qgs.kernels.projection import CAMERA_GRADIENTS, project_backward_unit

        saved = ctx.saved_tensors
        means, scales, quats, opacities, colors, c2w, lenses, rows, sums = _arrays(*saved)
        (batch, views, count), size = rows.shape[:3], sums.shape[-2:]
        stripes = _image_units(batch, views, size[0])
        units = _scene_units(batch, count)
        parts = 1 + max((part for *_, part in stripes), default=0)
        chunks = 1 + max((part for *_, part in units), default=0)
        # Each stripe adds up gradients of its own, in a fixed order whatever the threads.
        grads = saved[0].new_zeros((batch, views, parts, count, kernels.GRADIENTS)).numpy()
        given = slopes[0].contiguous().numpy()
        of_inputs = [torch.empty_like(tensor) for tensor in (*saved[:4], saved[0])]
        of_means, of_scales, of_quats, of_opacities, of_colors = _arrays(*of_inputs)
        # In float64: thousands of splats of either sign nearly cancel in a camera's gradient.
        of_cameras = torch.zeros((batch, chunks, views, CAMERA_GRADIENTS), dtype=torch.float64)
        camera_parts = of_cameras.numpy()
        wants_cameras = any(ctx.needs_input_grad[5:7])
        projection, blending = _limits(ctx.config)

        def blend(image: tuple[int, int], stripe: tuple[int, int], part: int) -> None:
            scene = opacities[image[0]], colors[image[: colors.ndim - 2]]
            kernels.backward_unit(
                rows[image], *scene, stripe, blending, sums[image], given[image], grads[image][part]
            )

        def project(scene: int, bounds: tuple[int, int], part: int) -> None:
            project_backward_unit(
                means[scene], scales[scene], quats[scene], c2w[scene], lenses[scene], bounds,
                _float32(size), projection, rows[scene], grads[scene], wants_cameras,
                of_means[scene], of_scales[scene], of_quats[scene], of_opacities[scene],
                of_colors[scene], camera_parts[scene, part],
            )  # fmt: skip

        in_threads(blend, stripes)
        in_threads(project, units)
        # Not to be added up over the views.
        if colors.ndim == 4:
            of_inputs[4] = torch.from_numpy(grads[..., -3:].sum(2))
        if not wants_cameras:
            return *of_inputs, None, None, None, None
        rotation, position, lens = of_cameras.sum(1).float().split([9, 3, 4], -1)
        pose = torch.cat([rotation.unflatten(-1, (3, 3)), position[..., None]], -1)
        return *of_inputs, torch.nn.functional.pad(pose, (0, 0, 0, 1)), lens, None, None


def _limits(config: RendererConfig) -> tuple[Any, Any]:
    """The kernels' options: those of the projection and those of the blending."""
    projection = (config.near, config.far, config.dilation, config.alpha_min, CLAMP_MARGIN)
    blending = (config.alpha_min, config.alpha_cap, config.transmittance_min)
    return _float32(projection), _float32(blending)


def _float32(options: tuple[float, ...]) -> tuple[Any, ...]:
    return tuple(np.float32(value) for value in options)


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().numpy() for tensor in tensors)


def _scene_units(batch: int, count: int) -> list[tuple[int, tuple[int, int], int]]:
    """Scene, range of Gaussians, number of the range."""
    return [
        (b, (start, min(start + _CHUNK, count)), part)
        for b in range(batch)
        for part, start in enumerate(range(0, count, _CHUNK))
    ]


def _image_units(
    batch: int, views: int, height: int
) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """Scene and view, range of tile rows, number of the range (several if images are few)."""
    rows = -(-height // _TILE)
    parts = min(rows, -(-_MIN_UNITS // max(batch * views, 1)))
    edges = [rows * part // parts for part in range(parts + 1)]
    return [
        ((b, v), stripe, part)
        for b in range(batch)
        for v in range(views)
        for part, stripe in enumerate(pairwise(edges))
    ]
